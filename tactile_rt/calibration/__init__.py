"""From what a device sends to the SI loads that a model knows, element by element.

output = mirror(map(matrix @ (raw - tare)))

correction   what one device needs, applied to its chunks and to its source
files        stored per device id, as TOML that people can read
taring       offsets and noise, measured while nothing is touched
loads        tables of known loads
fitting      the matrix, by least squares from such a table
"""

from tactile_rt.calibration.correction import CalibratedSource, Calibration
from tactile_rt.calibration.files import (
    calibration_path,
    load_calibration,
    save_calibration,
)
from tactile_rt.calibration.fitting import Fit, calibrate
from tactile_rt.calibration.loads import LoadTable, raw_readings, read_loads
from tactile_rt.calibration.mirroring import Mirror
from tactile_rt.calibration.taring import Tare, tare

__all__ = [
    "CalibratedSource",
    "Calibration",
    "Fit",
    "LoadTable",
    "Mirror",
    "Tare",
    "calibrate",
    "calibration_path",
    "load_calibration",
    "raw_readings",
    "read_loads",
    "save_calibration",
    "tare",
]
