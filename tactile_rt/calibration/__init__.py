"""From what a device sends to the SI loads that a model knows, element by element.

output = mirror(map(matrix @ (raw - tare)))

correction         what one device needs, applied to its chunks
calibrated_source  the same on a whole source, which may be declared to be another array's
files              stored per device id, as TOML that people can read
taring             offsets and noise, measured while nothing is touched
fitting            tables of known loads, and the matrix that they give
"""

from tactile_rt.calibration.calibrated_source import CalibratedSource, declare, declared
from tactile_rt.calibration.correction import Calibration, Mirror
from tactile_rt.calibration.files import calibration_path, load_calibration, save_calibration
from tactile_rt.calibration.fitting import Fit, LoadTable, calibrate, raw_readings, read_loads
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
    "declare",
    "declared",
    "load_calibration",
    "raw_readings",
    "read_loads",
    "save_calibration",
    "tare",
]
