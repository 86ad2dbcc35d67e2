"""Segmentation (III-B of the paper): words and an image in, soft masks with their sigma_mask out."""
