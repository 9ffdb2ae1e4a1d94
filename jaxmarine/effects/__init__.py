"""The catalogue of causes. The order is that in which effects of one stage act."""

from ._base import (
    AbstractEffect as AbstractEffect,
    Craft as Craft,
    DriveEffect as DriveEffect,
    LoadEffect as LoadEffect,
    Motion as Motion,
    Readings as Readings,
    SensorEffect as SensorEffect,
    Suspect as Suspect,
    WaterEffect as WaterEffect,
    WrenchEffect as WrenchEffect,
    blend as blend,
    place as place,
)
from ._drive import (
    Deadband as Deadband,
    InflowLoss as InflowLoss,
    InputDelay as InputDelay,
    Saturation as Saturation,
    ThrustCurve as ThrustCurve,
    ThrusterGain as ThrusterGain,
    ThrusterLag as ThrusterLag,
)
from ._load import AddedMass as AddedMass, Buoyancy as Buoyancy, Payload as Payload, Trim as Trim
from ._sensor import (
    GyroBias as GyroBias,
    VelocityInEarthAxes as VelocityInEarthAxes,
    VelocityLeverArm as VelocityLeverArm,
    VelocityMisalignment as VelocityMisalignment,
    VelocityScale as VelocityScale,
)
from ._water import SteadyCurrent as SteadyCurrent
from ._wrench import (
    ConstantWrench as ConstantWrench,
    CoupledDamping as CoupledDamping,
    FluidMemory as FluidMemory,
    HullLift as HullLift,
    LinearDamping as LinearDamping,
    QuadraticDamping as QuadraticDamping,
    TetherDrag as TetherDrag,
    Waves as Waves,
)

CATALOGUE: tuple[type[AbstractEffect], ...] = (
    InputDelay,
    Deadband,
    Saturation,
    ThrustCurve,
    ThrusterGain,
    ThrusterLag,
    InflowLoss,
    SteadyCurrent,
    Buoyancy,
    Trim,
    Payload,
    AddedMass,
    ConstantWrench,
    LinearDamping,
    QuadraticDamping,
    CoupledDamping,
    HullLift,
    TetherDrag,
    Waves,
    FluidMemory,
    VelocityLeverArm,
    VelocityMisalignment,
    VelocityScale,
    VelocityInEarthAxes,
    GyroBias,
)
