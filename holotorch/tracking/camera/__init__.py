"""The camera: model, calibration, tone curve."""
