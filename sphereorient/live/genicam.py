"""Pictures of GenICam cameras, through the producer (.cti) that their maker's driver brings; extra `genicam`."""

from collections.abc import Iterator

import numpy as np

from sphereorient.errors import MovieError, error_words, refusal
from sphereorient.live.feed import Picture

WAIT_S = 1.0  # of one call of the driver; a camera that waits for its trigger is asked again


def genicam_pictures(where: str) -> Iterator[Picture]:
    """Yield grey pictures of the first camera of PRODUCER.cti, or that of a serial number: PRODUCER.cti#SERIAL.

    Raises:
        MovieError: the package harvesters is missing, no such camera, one of colour, or one that fails.
    """
    name = f"genicam:{where}"
    try:
        from harvesters.core import Harvester, TimeoutException
    except ImportError:
        do = "install it with `pip install 'sphereorient[genicam]'`"
        raise MovieError(refusal(name, expected="the package harvesters", got="none", do=do)) from None
    producer, _, serial = where.partition("#")
    try:
        with Harvester() as harvester:
            harvester.add_file(producer, check_existence=True, check_validity=True)
            harvester.update()
            if not harvester.device_info_list:
                do = "connect it, or close the program that has it"
                raise MovieError(refusal(name, expected="a camera", got="none", do=do))
            with harvester.create({"serial_number": serial} if serial else 0) as camera:
                camera.start()
                while True:
                    try:
                        buffer = camera.fetch(timeout=WAIT_S)
                    except TimeoutException:
                        continue
                    with buffer:  # its memory is the driver's again behind this
                        shown = buffer.payload.components[0]
                        if not shown.data_format.startswith("Mono"):
                            do = "set its PixelFormat to Mono8 or Mono16"
                            raise MovieError(refusal(name, expected="grey pictures", got=shown.data_format, do=do))
                        picture = np.array(shown.data.reshape(shown.height, -1)[:, : shown.width])  # padding behind
                    yield picture
    except MovieError:
        raise
    except Exception as error:  # each driver has errors of its own
        do = "look whether the maker's viewer shows its pictures"
        raise MovieError(refusal(name, expected="a camera that works", got=error_words(error), do=do)) from None
