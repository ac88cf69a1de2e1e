"""From what a device sends to the SI loads that a model knows, element by element.

output = mirror(map(matrix @ (raw - tare)))

device_calibration  what one device needs, applied to its chunks: tare, matrix, mapping, mirror
calibrated_source   the same on a whole source, which may be declared to be another array's
files               stored per device id, as TOML that people can read
tare_measurement    offsets and noise, measured while nothing is touched
calibration_fit     tables of known loads, and the matrix that they give
"""

from tactile_rt.calibration.calibrated_source import CalibratedSource, declare, declared
from tactile_rt.calibration.calibration_fit import (
    Fit,
    LoadTable,
    calibrate,
    raw_readings,
    read_loads,
)
from tactile_rt.calibration.device_calibration import Calibration, Mirror
from tactile_rt.calibration.files import calibration_path, load_calibration, save_calibration
from tactile_rt.calibration.tare_measurement import Tare, tare

__all__ = [
    "CalibratedSource",
    "Calibration",
    "Fit",
    "LoadTable",
    "Mirror",
    "Tare",
    "calibrate",
    "calibration_path",
    "declare",
    "declared",
    "load_calibration",
    "raw_readings",
    "read_loads",
    "save_calibration",
    "tare",
]
