"""The part of a run's page that can be played: 3D view, cameras' images and plots on one time slider."""
