"""Parameters of a virtual camera, estimated from ordinary recordings of a user's own cameras, with uncertainties.

The input is images, detections and tracks. The output is values with standard deviations, or the reason why the
recordings do not determine a value. Nothing here depends on the twin: keys are those of a scenario's ``[[camera]]``
table.
"""
