"""What ordinary recordings tell of one's own cameras: parameters of a virtual camera, each with its uncertainty.

Images, detections and tracks go in, values with standard deviations come out, or the reason why these recordings do
not tell. Nothing here knows the twin: keys are those of a scenario's ``[[camera]]`` table.
"""
