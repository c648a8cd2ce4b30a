"""Labels without training: tracks of a person are matched with a template of the marker set."""
