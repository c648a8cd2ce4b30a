"""A source of frames on the network as GigE Vision cameras: each camera a device of its own at an address of its own.

From outside in: ``serve`` puts a source's cameras on addresses; ``camera`` is one device; ``control`` answers the
control protocol (GVCP) and ``stream`` sends the images (GVSP); ``registers`` and ``features`` are what a client can read
and set, ``genicam`` the XML file that tells it so; ``shutter`` decides which trigger makes an exposure; ``clock`` is the
device's own time; ``line`` makes the pulses; ``faults`` says what goes wrong; ``store`` keeps the frames.

Written from the GigE Vision and GenICam SFNC standards as public clients and documents show them; it is not certified.
"""
