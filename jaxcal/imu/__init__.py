"""IMU measurement models."""

from jaxcal.imu.calibrated import predict
from jaxcal.imu.models import IMU_MODELS, ImuModel, imu_model, respond

__all__ = ["IMU_MODELS", "ImuModel", "imu_model", "predict", "respond"]
