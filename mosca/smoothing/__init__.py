"""Smoothing of tracks: Rauch-Tung-Striebel after the fact, and a smoother with a fixed lag."""
