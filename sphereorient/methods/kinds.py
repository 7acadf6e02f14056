"""The methods of `track` by name. A new one is a file of this room, a line here, and the settings that it reads."""

from sphereorient.methods.method import Method
from sphereorient.methods.paper import PAPER
from sphereorient.methods.precise import PRECISE

METHODS: dict[str, Method] = {"precise": PRECISE, "paper": PAPER}
