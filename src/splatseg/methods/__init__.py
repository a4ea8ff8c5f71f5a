"""Methods: evidence to layers, each named as its paper or the field names it."""
