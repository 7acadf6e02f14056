"""Tools beside tracking: paint to print, comparing maps, photographs of a spinning ball."""
