"""How often intervals and bands hold the truth."""
