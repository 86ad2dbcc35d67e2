"""Section III-C of the paper: what photographs tell about the map, weighed by one metric of reliability."""
