"""Labels of markers on a deforming surface, such as a face, from their usual places and common movements."""
