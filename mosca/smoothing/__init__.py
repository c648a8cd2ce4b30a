"""Tracks after the fact: Rauch-Tung-Striebel smoothing, and a smoother with a fixed lag."""
