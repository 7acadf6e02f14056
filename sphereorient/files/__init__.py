"""Files: atomic writing, HDF5, bounded YAML, provenance, the size of a picture before it is decoded."""
