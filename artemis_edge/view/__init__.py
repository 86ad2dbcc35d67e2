"""The map in a browser (extra ``view``): a finished one, or one that is growing."""
