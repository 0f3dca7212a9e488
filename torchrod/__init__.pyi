"""The whole public surface of torchrod: every name once, with its home. `__init__.py` imports each on first use."""

from .analysis.calibration import (
    Calibration as Calibration,
)
from .analysis.calibration import (
    calibrate as calibrate,
)
from .analysis.common_frame import (
    BaseFrame as BaseFrame,
)
from .analysis.common_frame import (
    common_frame as common_frame,
)
from .analysis.diagnosis import (
    Diagnosis as Diagnosis,
)
from .analysis.diagnosis import (
    diagnose as diagnose,
)
from .analysis.marker_placement import (
    Placement as Placement,
)
from .analysis.marker_placement import (
    place as place,
)
from .analysis.noise import (
    Noise as Noise,
)
from .analysis.noise import (
    estimate_noise as estimate_noise,
)
from .analysis.noise import (
    estimate_noise_among as estimate_noise_among,
)
from .analysis.observability import (
    Observability as Observability,
)
from .analysis.observability import (
    bounds as bounds,
)
from .analysis.observability import (
    load_bound as load_bound,
)
from .analysis.tracker import Estimator as Estimator
from .data.dataset import (
    DatasetSpec as DatasetSpec,
)
from .data.dataset import (
    simulate_shard as simulate_shard,
)
from .data.shards import (
    Dataset as Dataset,
)
from .data.shards import (
    read_dataset as read_dataset,
)
from .data.spec_file import read_dataset_spec as read_dataset_spec
from .estimation.fit import Fit as Fit
from .estimation.load_profile import (
    Profile as Profile,
)
from .estimation.load_profile import (
    load_profile as load_profile,
)
from .estimation.result import Estimate as Estimate
from .estimation.solve import (
    Settings as Settings,
)
from .estimation.solve import (
    estimate as estimate,
)
from .estimation.solve import (
    paper_settings as paper_settings,
)
from .estimation.starts import (
    Start as Start,
)
from .estimation.starts import (
    cold_start as cold_start,
)
from .io import (
    Shapes as Shapes,
)
from .io import (
    read_robot as read_robot,
)
from .io import (
    read_shapes as read_shapes,
)
from .io import (
    write_result as write_result,
)
from .io import (
    write_shapes as write_shapes,
)
from .learned.warm_start import (
    WarmStart as WarmStart,
)
from .learned.warm_start import (
    find_warm_start as find_warm_start,
)
from .mechanics.actuation import (
    Actuated as Actuated,
)
from .mechanics.actuation import (
    reference_lengths as reference_lengths,
)
from .mechanics.actuation import (
    solve_displacement as solve_displacement,
)
from .mechanics.jacobian import forward_jacobian as forward_jacobian
from .mechanics.loads import (
    FourierLoads as FourierLoads,
)
from .mechanics.loads import (
    GaussianLoads as GaussianLoads,
)
from .mechanics.loads import (
    PointForces as PointForces,
)
from .mechanics.loads import (
    PointWrenches as PointWrenches,
)
from .mechanics.loads import (
    PolynomialLoads as PolynomialLoads,
)
from .mechanics.robot import Robot as Robot
from .mechanics.rod import Rod as Rod
from .mechanics.statics import (
    Equilibrium as Equilibrium,
)
from .mechanics.statics import (
    Shape as Shape,
)
from .mechanics.statics import (
    shape_from_base as shape_from_base,
)
from .mechanics.statics import (
    solve_shape as solve_shape,
)
from .mechanics.tendons import (
    Tendon as Tendon,
)
from .mechanics.tendons import (
    Tendons as Tendons,
)
from .model.load_families import (
    FourierCoordinates as FourierCoordinates,
)
from .model.load_families import (
    GaussianCoordinates as GaussianCoordinates,
)
from .model.load_families import (
    PaperCoordinates as PaperCoordinates,
)
from .model.load_families import (
    PointCoordinates as PointCoordinates,
)
from .model.measurement import (
    Markers as Markers,
)
from .model.measurement import (
    Model as Model,
)
from .plotting.estimate import (
    draw as draw,
)
from .plotting.estimate import (
    draw_on as draw_on,
)
from .util.errors import InputError as InputError
from .util.status import Status as Status

__version__: str
