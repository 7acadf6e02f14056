"""The optional learned proposer. Only training imports `train`: pytorch_lightning takes seconds."""
