"""Bundle adjustment: the solver that all calibrations share; entry point: ``solver``."""
