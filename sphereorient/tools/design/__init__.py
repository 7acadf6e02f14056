"""Paint to print: designs, gores, how well a design fixes the orientation."""
