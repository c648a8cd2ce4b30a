"""Linear models of driven bodies from their measured motion and the commands that drove them."""
