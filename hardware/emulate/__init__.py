"""A source of frames on the network as GigE Vision cameras: each camera a device of its own at an address of its own.

From outside in: ``serve`` puts a source's cameras on addresses; a ``device`` is one of them, its ``camera`` with two
channels: ``control`` takes commands (GVCP; packets in ``gvcp``, who may in ``privilege``) and ``stream`` sends images
(GVSP; packets in ``gvsp``). ``registers`` and ``features`` are what a client can read and set, ``genicam`` the XML
file that tells it so, ``identity`` what they hold at first. ``acquisition`` and ``shutter`` decide which trigger
makes an exposure, ``clock`` is the device's own time, ``line`` makes the pulses, ``faults`` says what goes wrong,
``store`` keeps the frames. ``standard`` has the standard's numbers.

Written from GigE Vision 2.0 and the GenICam SFNC as public clients and documents show them; it is not certified.
"""
