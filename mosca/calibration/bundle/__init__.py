"""Bundle adjustment: the one solver that every calibration shares; its door is ``solver``."""
