"""Rigs for the daemon: `tactile-rt bench daemon`."""
