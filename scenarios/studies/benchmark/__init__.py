"""The public benchmark: data sets as plain files, entrants in environments of their own, one scoring for all."""
