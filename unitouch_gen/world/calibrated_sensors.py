"""Real sensors, as far as published measurements of them tell.

Lights and backgrounds are fitted to calibration tables and frames by `python -m tests.benchmarks.calibration`. For each
sensor `calibrated_sensors.json` names sources and licences, and parts its values by where they are from: `published` by
a source, `measured` on its frames, `fitted` to them, or `guessed`, where no source tells. `settings` are of rendering.
"""

import json
from pathlib import Path
from typing import Any

from unitouch_gen.world.sensors import Sensor

NUMBERS = Path(__file__).with_name("calibrated_sensors.json")

KINDS = ("published", "measured", "fitted", "guessed", "settings")


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def sensor_from(name: str, entry: dict[str, Any]) -> Sensor:
    """Sensor of one entry of the file."""
    values = {field: _tuples(value) for kind in KINDS for field, value in entry[kind].items()}
    return Sensor(name, **values)


CALIBRATED: dict[str, Sensor] = {
    name: sensor_from(name, entry) for name, entry in json.loads(NUMBERS.read_text(encoding="utf-8")).items()
}
"""By name; beside `SENSORS`, whose numbers are plausible, and apart from them: no built-in weights know these."""
