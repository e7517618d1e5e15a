"""The page: a viser server, its scene and one file per tab."""
