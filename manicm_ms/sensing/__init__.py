"""From a camera to a cloud: camera files, calibration, depth errors, point clouds, and what realism draws."""
