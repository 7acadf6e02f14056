"""The optional learned proposer: a network, its training data and its training.

`train` and `module` import pytorch_lightning, which takes seconds: only `sphereorient train` imports them.
"""
