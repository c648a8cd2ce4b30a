"""Acceptance tests of tracks against calibrated artefacts, in the manner of VDI/VDE 2634-1 and ASTM E3064, E3124."""
