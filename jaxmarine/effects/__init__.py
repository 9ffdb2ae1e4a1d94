"""The catalogue of causes. The order is that in which effects of one stage act."""

from ._actuator import CrossFlowDrag as CrossFlowDrag
from ._actuator import SurfaceGain as SurfaceGain
from ._actuator import SurfaceLag as SurfaceLag
from ._actuator import SurfaceOffset as SurfaceOffset
from ._actuator import SurfaceRate as SurfaceRate
from ._actuator import SurfaceStuck as SurfaceStuck
from ._actuator import Voltage as Voltage
from ._actuator import Wake as Wake
from ._actuator import WindLoad as WindLoad
from ._base import (
    AbstractEffect as AbstractEffect,
)
from ._base import (
    ActuatorEffect as ActuatorEffect,
)
from ._base import (
    Craft as Craft,
)
from ._base import (
    DriveEffect as DriveEffect,
)
from ._base import (
    LoadEffect as LoadEffect,
)
from ._base import (
    Motion as Motion,
)
from ._base import (
    Readings as Readings,
)
from ._base import (
    SensorEffect as SensorEffect,
)
from ._base import (
    Suspect as Suspect,
)
from ._base import (
    WaterEffect as WaterEffect,
)
from ._base import (
    WrenchEffect as WrenchEffect,
)
from ._base import (
    blend as blend,
)
from ._base import (
    each as each,
)
from ._base import (
    place as place,
)
from ._base import (
    whole as whole,
)
from ._drive import (
    Deadband as Deadband,
)
from ._drive import (
    ExchangedThrusters as ExchangedThrusters,
)
from ._drive import (
    InflowLoss as InflowLoss,
)
from ._drive import (
    InputDelay as InputDelay,
)
from ._drive import (
    ReverseThrust as ReverseThrust,
)
from ._drive import (
    Saturation as Saturation,
)
from ._drive import (
    ThrustCurve as ThrustCurve,
)
from ._drive import (
    ThrusterGain as ThrusterGain,
)
from ._drive import (
    ThrusterLag as ThrusterLag,
)
from ._load import JOINED as JOINED
from ._load import AddedMass as AddedMass
from ._load import Buoyancy as Buoyancy
from ._load import CoupledAddedMass as CoupledAddedMass
from ._load import Payload as Payload
from ._load import Trim as Trim
from ._sensor import (
    CompassDeviation as CompassDeviation,
)
from ._sensor import (
    GyroBias as GyroBias,
)
from ._sensor import (
    SensorDelay as SensorDelay,
)
from ._sensor import (
    VelocityInEarthAxes as VelocityInEarthAxes,
)
from ._sensor import (
    VelocityLeverArm as VelocityLeverArm,
)
from ._sensor import (
    VelocityMisalignment as VelocityMisalignment,
)
from ._sensor import (
    VelocityScale as VelocityScale,
)
from ._water import SteadyCurrent as SteadyCurrent
from ._words import Found as Found
from ._words import listed as listed
from ._words import push as push
from ._wrench import (
    ConstantWrench as ConstantWrench,
)
from ._wrench import (
    CoupledDamping as CoupledDamping,
)
from ._wrench import (
    FluidMemory as FluidMemory,
)
from ._wrench import (
    HullLift as HullLift,
)
from ._wrench import (
    LinearDamping as LinearDamping,
)
from ._wrench import (
    QuadraticDamping as QuadraticDamping,
)
from ._wrench import (
    TetherDrag as TetherDrag,
)
from ._wrench import (
    TurningLift as TurningLift,
)
from ._wrench import (
    Waves as Waves,
)
from ._wrench import (
    WindPush as WindPush,
)

CATALOGUE: tuple[type[AbstractEffect], ...] = (
    ExchangedThrusters,
    InputDelay,
    Deadband,
    Saturation,
    ThrustCurve,
    ThrusterGain,
    ReverseThrust,
    ThrusterLag,
    InflowLoss,
    SurfaceGain,
    SurfaceOffset,
    SurfaceStuck,
    SurfaceLag,
    SurfaceRate,
    Wake,
    Voltage,
    CrossFlowDrag,
    WindLoad,
    SteadyCurrent,
    Buoyancy,
    Trim,
    Payload,
    AddedMass,
    CoupledAddedMass,
    ConstantWrench,
    LinearDamping,
    QuadraticDamping,
    CoupledDamping,
    HullLift,
    TurningLift,
    TetherDrag,
    WindPush,
    Waves,
    FluidMemory,
    VelocityLeverArm,
    VelocityMisalignment,
    VelocityScale,
    VelocityInEarthAxes,
    GyroBias,
    CompassDeviation,
    SensorDelay,
)
