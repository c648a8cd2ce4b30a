"""OptiTrack's NatNet: the messages, and a server that unmodified clients take for a lab's."""
