"""Skeletons and their motion; readers of BVH, ASF/AMC and CSV."""
