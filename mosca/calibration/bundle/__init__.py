"""Bundle adjustment: the one solver that every calibration shares; entry point: ``solver``."""
