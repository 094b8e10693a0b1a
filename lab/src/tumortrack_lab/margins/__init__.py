"""Calibration of margins: scenes of known truth -> the ``ModelMargins`` that a model states."""
