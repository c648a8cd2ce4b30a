"""The real rig. No driver is built in yet; the room keeps the door that scenarios open."""
