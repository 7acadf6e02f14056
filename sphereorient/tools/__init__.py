"""Tools beside tracking: design of a texture, wear of a ball, spin from photographs."""
