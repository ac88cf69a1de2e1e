"""Calibration: conversion of a device's raw samples to SI loads of an array that a model knows.

output = mirror(map(matrix @ (raw - tare)))

device_calibration  calibration of one device, applied to chunks: tare, matrix, mapping, mirror
calibrated_source   calibration of a whole source, which may be declared to be of another array
files               storage by device id, as TOML that people can read
tare_measurement    offsets and noise, measured while nothing is touched
calibration_fit     fit of the matrix to a table of known loads
"""

from tactile_rt.calibration.calibrated_source import CalibratedSource, declare, declare_calibration
from tactile_rt.calibration.calibration_fit import (
    Fit,
    LoadTable,
    calibrate,
    median_readings,
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
    "declare_calibration",
    "load_calibration",
    "median_readings",
    "read_loads",
    "save_calibration",
    "tare",
]
