"""The optional learned proposer. Only training imports `train` and `module`: pytorch_lightning takes seconds."""
