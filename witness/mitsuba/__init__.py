"""Whole recordings rendered by Mitsuba 3 (extra ``witness``): images that the project's virtual cameras did not make.

``scene.py``: the scene in plain values; ``scene_file.py``: its TOML files; ``projection.py``: OpenCV's lens;
``transport.py``: rays, lights and surfaces through Mitsuba; ``film.py``: windows around targets; ``cramer_rao.py``:
bounds; ``sensor.py``: noise and counts; ``recording.py``: the folder that is written. ``python -m witness.mitsuba
SCENE.toml --out DIR`` runs all of them. The package imports nothing of the project.

World: right-handed, metres. LensCamera: x right, y down, z forward. Pixel (0, 0) is the centre of the top-left pixel.
"""
