"""How numerical code is compiled and where compiled code is kept."""
