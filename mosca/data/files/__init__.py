"""Files of the vocabulary: rigs, targets, arrays; whole or not at all."""
