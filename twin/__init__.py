"""The twin makes exposures and the truth.

It shares conventions and parameter numbers with the pipeline, never formulas.
"""
