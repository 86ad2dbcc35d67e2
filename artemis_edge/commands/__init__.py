"""Commands of the command line by area; ``cli.py`` puts them together."""
