"""GigE Vision cameras emulated from a source of frames: each camera is a device with its own address on the network.

- ``serve``: puts a source's cameras on addresses; a device is a ``camera`` with two channels
- ``control`` (GVCP) takes commands; ``stream`` (GVSP) sends images; ``gige_vision``: numbers and datagrams
- ``registers`` and ``features``: what a client can read and set; ``genicam``: the XML file that describes it;
  ``identity``: values at power-on
- ``acquisition``: device clock, shutter, which trigger makes an exposure; ``pulse_generators``; ``faults``
- ``store``: frames read ahead of the pulses

Written from GigE Vision 2.0 and the GenICam SFNC as public clients and documents show them; it is not certified.
"""
