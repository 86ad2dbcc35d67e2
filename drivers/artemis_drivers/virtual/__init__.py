"""The virtual rig: worlds built from code, and sensors that walk through them with ground truth."""
