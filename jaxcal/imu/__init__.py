"""IMU measurement models."""

from jaxcal.imu.calibrated import predict, predict_with_jacobian

__all__ = ["predict", "predict_with_jacobian"]
