"""Real cameras and triggers: drivers, pulse numbering, the rig as a source of frames, and emulated cameras."""

import logging

# a library prints nothing by itself: an application adds a handler
logging.getLogger("mosca.hardware").addHandler(logging.NullHandler())
