"""A map in the coordinates of a country: control points, the fit, what is written (extra ``geo``)."""
