"""What residuals say about cameras: noise that matching uses, and faults for people."""
