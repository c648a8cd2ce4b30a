"""Data association: from frames of unsynchronised cameras to image tracks of one marker each."""
