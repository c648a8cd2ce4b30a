"""One vendor SDK a file, imported when it is opened."""
