"""Labels of markers on a deforming surface, a face: from where people have them and how they move together."""
