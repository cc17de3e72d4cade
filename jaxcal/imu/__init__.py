"""IMU measurement models."""

from jaxcal.imu.calibrated import predict, predict_with_jacobian
from jaxcal.imu.models import IMU_MODELS, ImuModel, imu_model, respond

__all__ = ["IMU_MODELS", "ImuModel", "imu_model", "predict", "predict_with_jacobian", "respond"]
