# mypy: disable-error-code="type-arg"
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class SensorPosition(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SENSOR_POSITION_UNSPECIFIED: _ClassVar[SensorPosition]
    SPRUNG_FRONT: _ClassVar[SensorPosition]
    SPRUNG_REAR: _ClassVar[SensorPosition]
    UNSPRUNG_FRONT: _ClassVar[SensorPosition]
    UNSPRUNG_REAR: _ClassVar[SensorPosition]

class Direction(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DIRECTION_UNSPECIFIED: _ClassVar[Direction]
    START_TO_END: _ClassVar[Direction]
    END_TO_START: _ClassVar[Direction]

class CrossingState(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    CROSSING_STATE_UNSPECIFIED: _ClassVar[CrossingState]
    DETECTED: _ClassVar[CrossingState]
    COMPLETE: _ClassVar[CrossingState]
    WAITING_NOT_VALIDATED: _ClassVar[CrossingState]
    IDENTIFYING: _ClassVar[CrossingState]
    DONE: _ClassVar[CrossingState]

class Verdict(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    VERDICT_UNSPECIFIED: _ClassVar[Verdict]
    GOOD: _ClassVar[Verdict]
    SUSPECT: _ClassVar[Verdict]
    REJECTED: _ClassVar[Verdict]
SENSOR_POSITION_UNSPECIFIED: SensorPosition
SPRUNG_FRONT: SensorPosition
SPRUNG_REAR: SensorPosition
UNSPRUNG_FRONT: SensorPosition
UNSPRUNG_REAR: SensorPosition
DIRECTION_UNSPECIFIED: Direction
START_TO_END: Direction
END_TO_START: Direction
CROSSING_STATE_UNSPECIFIED: CrossingState
DETECTED: CrossingState
COMPLETE: CrossingState
WAITING_NOT_VALIDATED: CrossingState
IDENTIFYING: CrossingState
DONE: CrossingState
VERDICT_UNSPECIFIED: Verdict
GOOD: Verdict
SUSPECT: Verdict
REJECTED: Verdict

class AccelChannel(_message.Message):
    __slots__ = ("position", "rate_hz", "acceleration_m_per_s2", "name")
    POSITION_FIELD_NUMBER: _ClassVar[int]
    RATE_HZ_FIELD_NUMBER: _ClassVar[int]
    ACCELERATION_M_PER_S2_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    position: SensorPosition
    rate_hz: float
    acceleration_m_per_s2: _containers.RepeatedScalarFieldContainer[float]
    name: str
    def __init__(self, position: _Optional[_Union[SensorPosition, str]] = ..., rate_hz: _Optional[float] = ..., acceleration_m_per_s2: _Optional[_Iterable[float]] = ..., name: _Optional[str] = ...) -> None: ...

class AccelBatch(_message.Message):
    __slots__ = ("schema_version", "boot_id", "sequence", "device_time_ns", "wall_time_ns", "channels")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    DEVICE_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    WALL_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    CHANNELS_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    boot_id: int
    sequence: int
    device_time_ns: int
    wall_time_ns: int
    channels: _containers.RepeatedCompositeFieldContainer[AccelChannel]
    def __init__(self, schema_version: _Optional[int] = ..., boot_id: _Optional[int] = ..., sequence: _Optional[int] = ..., device_time_ns: _Optional[int] = ..., wall_time_ns: _Optional[int] = ..., channels: _Optional[_Iterable[_Union[AccelChannel, _Mapping]]] = ...) -> None: ...

class GnssFix(_message.Message):
    __slots__ = ("schema_version", "boot_id", "sequence", "device_time_ns", "wall_time_ns", "latitude_deg", "longitude_deg", "altitude_m", "speed_m_per_s", "heading_deg", "horizontal_accuracy_m", "vertical_accuracy_m", "speed_accuracy_m_per_s")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    DEVICE_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    WALL_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    LATITUDE_DEG_FIELD_NUMBER: _ClassVar[int]
    LONGITUDE_DEG_FIELD_NUMBER: _ClassVar[int]
    ALTITUDE_M_FIELD_NUMBER: _ClassVar[int]
    SPEED_M_PER_S_FIELD_NUMBER: _ClassVar[int]
    HEADING_DEG_FIELD_NUMBER: _ClassVar[int]
    HORIZONTAL_ACCURACY_M_FIELD_NUMBER: _ClassVar[int]
    VERTICAL_ACCURACY_M_FIELD_NUMBER: _ClassVar[int]
    SPEED_ACCURACY_M_PER_S_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    boot_id: int
    sequence: int
    device_time_ns: int
    wall_time_ns: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    speed_m_per_s: float
    heading_deg: float
    horizontal_accuracy_m: float
    vertical_accuracy_m: float
    speed_accuracy_m_per_s: float
    def __init__(self, schema_version: _Optional[int] = ..., boot_id: _Optional[int] = ..., sequence: _Optional[int] = ..., device_time_ns: _Optional[int] = ..., wall_time_ns: _Optional[int] = ..., latitude_deg: _Optional[float] = ..., longitude_deg: _Optional[float] = ..., altitude_m: _Optional[float] = ..., speed_m_per_s: _Optional[float] = ..., heading_deg: _Optional[float] = ..., horizontal_accuracy_m: _Optional[float] = ..., vertical_accuracy_m: _Optional[float] = ..., speed_accuracy_m_per_s: _Optional[float] = ...) -> None: ...

class VehicleInfo(_message.Message):
    __slots__ = ("schema_version", "boot_id", "sequence", "device_time_ns", "wall_time_ns", "vehicle_id", "site_toml")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    DEVICE_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    WALL_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    VEHICLE_ID_FIELD_NUMBER: _ClassVar[int]
    SITE_TOML_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    boot_id: int
    sequence: int
    device_time_ns: int
    wall_time_ns: int
    vehicle_id: str
    site_toml: str
    def __init__(self, schema_version: _Optional[int] = ..., boot_id: _Optional[int] = ..., sequence: _Optional[int] = ..., device_time_ns: _Optional[int] = ..., wall_time_ns: _Optional[int] = ..., vehicle_id: _Optional[str] = ..., site_toml: _Optional[str] = ...) -> None: ...

class Crossing(_message.Message):
    __slots__ = ("schema_version", "crossing_id", "vehicle", "bridge", "direction", "state", "time_ns", "entry_time_ns", "exit_time_ns")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    CROSSING_ID_FIELD_NUMBER: _ClassVar[int]
    VEHICLE_FIELD_NUMBER: _ClassVar[int]
    BRIDGE_FIELD_NUMBER: _ClassVar[int]
    DIRECTION_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    ENTRY_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    EXIT_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    crossing_id: str
    vehicle: str
    bridge: str
    direction: Direction
    state: CrossingState
    time_ns: int
    entry_time_ns: int
    exit_time_ns: int
    def __init__(self, schema_version: _Optional[int] = ..., crossing_id: _Optional[str] = ..., vehicle: _Optional[str] = ..., bridge: _Optional[str] = ..., direction: _Optional[_Union[Direction, str]] = ..., state: _Optional[_Union[CrossingState, str]] = ..., time_ns: _Optional[int] = ..., entry_time_ns: _Optional[int] = ..., exit_time_ns: _Optional[int] = ...) -> None: ...

class Prior(_message.Message):
    __slots__ = ("distribution", "location", "scale", "probability_zero")
    DISTRIBUTION_FIELD_NUMBER: _ClassVar[int]
    LOCATION_FIELD_NUMBER: _ClassVar[int]
    SCALE_FIELD_NUMBER: _ClassVar[int]
    PROBABILITY_ZERO_FIELD_NUMBER: _ClassVar[int]
    distribution: str
    location: float
    scale: float
    probability_zero: float
    def __init__(self, distribution: _Optional[str] = ..., location: _Optional[float] = ..., scale: _Optional[float] = ..., probability_zero: _Optional[float] = ...) -> None: ...

class Parameter(_message.Message):
    __slots__ = ("unit", "mean", "std", "q025", "q50", "q975", "prior")
    UNIT_FIELD_NUMBER: _ClassVar[int]
    MEAN_FIELD_NUMBER: _ClassVar[int]
    STD_FIELD_NUMBER: _ClassVar[int]
    Q025_FIELD_NUMBER: _ClassVar[int]
    Q50_FIELD_NUMBER: _ClassVar[int]
    Q975_FIELD_NUMBER: _ClassVar[int]
    PRIOR_FIELD_NUMBER: _ClassVar[int]
    unit: str
    mean: float
    std: float
    q025: float
    q50: float
    q975: float
    prior: Prior
    def __init__(self, unit: _Optional[str] = ..., mean: _Optional[float] = ..., std: _Optional[float] = ..., q025: _Optional[float] = ..., q50: _Optional[float] = ..., q975: _Optional[float] = ..., prior: _Optional[_Union[Prior, _Mapping]] = ...) -> None: ...

class Covariance(_message.Message):
    __slots__ = ("names", "matrix")
    NAMES_FIELD_NUMBER: _ClassVar[int]
    MATRIX_FIELD_NUMBER: _ClassVar[int]
    names: _containers.RepeatedScalarFieldContainer[str]
    matrix: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, names: _Optional[_Iterable[str]] = ..., matrix: _Optional[_Iterable[float]] = ...) -> None: ...

class RoadMismatch(_message.Message):
    __slots__ = ("a_m3", "n_0_per_m", "common_share", "bridge_ratio")
    A_M3_FIELD_NUMBER: _ClassVar[int]
    N_0_PER_M_FIELD_NUMBER: _ClassVar[int]
    COMMON_SHARE_FIELD_NUMBER: _ClassVar[int]
    BRIDGE_RATIO_FIELD_NUMBER: _ClassVar[int]
    a_m3: float
    n_0_per_m: float
    common_share: float
    bridge_ratio: float
    def __init__(self, a_m3: _Optional[float] = ..., n_0_per_m: _Optional[float] = ..., common_share: _Optional[float] = ..., bridge_ratio: _Optional[float] = ...) -> None: ...

class RoadResult(_message.Message):
    __slots__ = ("x_m", "front_m", "rear_m", "mean_m", "std_m", "iri_m_per_km", "iso_class", "mismatch")
    X_M_FIELD_NUMBER: _ClassVar[int]
    FRONT_M_FIELD_NUMBER: _ClassVar[int]
    REAR_M_FIELD_NUMBER: _ClassVar[int]
    MEAN_M_FIELD_NUMBER: _ClassVar[int]
    STD_M_FIELD_NUMBER: _ClassVar[int]
    IRI_M_PER_KM_FIELD_NUMBER: _ClassVar[int]
    ISO_CLASS_FIELD_NUMBER: _ClassVar[int]
    MISMATCH_FIELD_NUMBER: _ClassVar[int]
    x_m: _containers.RepeatedScalarFieldContainer[float]
    front_m: _containers.RepeatedScalarFieldContainer[float]
    rear_m: _containers.RepeatedScalarFieldContainer[float]
    mean_m: _containers.RepeatedScalarFieldContainer[float]
    std_m: _containers.RepeatedScalarFieldContainer[float]
    iri_m_per_km: float
    iso_class: str
    mismatch: RoadMismatch
    def __init__(self, x_m: _Optional[_Iterable[float]] = ..., front_m: _Optional[_Iterable[float]] = ..., rear_m: _Optional[_Iterable[float]] = ..., mean_m: _Optional[_Iterable[float]] = ..., std_m: _Optional[_Iterable[float]] = ..., iri_m_per_km: _Optional[float] = ..., iso_class: _Optional[str] = ..., mismatch: _Optional[_Union[RoadMismatch, _Mapping]] = ...) -> None: ...

class AtEnds(_message.Message):
    __slots__ = ("start", "end")
    START_FIELD_NUMBER: _ClassVar[int]
    END_FIELD_NUMBER: _ClassVar[int]
    start: float
    end: float
    def __init__(self, start: _Optional[float] = ..., end: _Optional[float] = ...) -> None: ...

class Thirds(_message.Message):
    __slots__ = ("left", "middle", "right")
    LEFT_FIELD_NUMBER: _ClassVar[int]
    MIDDLE_FIELD_NUMBER: _ClassVar[int]
    RIGHT_FIELD_NUMBER: _ClassVar[int]
    left: Parameter
    middle: Parameter
    right: Parameter
    def __init__(self, left: _Optional[_Union[Parameter, _Mapping]] = ..., middle: _Optional[_Union[Parameter, _Mapping]] = ..., right: _Optional[_Union[Parameter, _Mapping]] = ...) -> None: ...

class Derived(_message.Message):
    __slots__ = ("f1_hz", "max_deflection_m", "probability_below_90_percent_of_baseline", "probability_sprung", "probability_giving", "springs_believed", "ei_level", "ei_thirds", "probability_torsion")
    class ProbabilityBelow90PercentOfBaselineEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    F1_HZ_FIELD_NUMBER: _ClassVar[int]
    MAX_DEFLECTION_M_FIELD_NUMBER: _ClassVar[int]
    PROBABILITY_BELOW_90_PERCENT_OF_BASELINE_FIELD_NUMBER: _ClassVar[int]
    PROBABILITY_SPRUNG_FIELD_NUMBER: _ClassVar[int]
    PROBABILITY_GIVING_FIELD_NUMBER: _ClassVar[int]
    SPRINGS_BELIEVED_FIELD_NUMBER: _ClassVar[int]
    EI_LEVEL_FIELD_NUMBER: _ClassVar[int]
    EI_THIRDS_FIELD_NUMBER: _ClassVar[int]
    PROBABILITY_TORSION_FIELD_NUMBER: _ClassVar[int]
    f1_hz: Parameter
    max_deflection_m: Parameter
    probability_below_90_percent_of_baseline: _containers.ScalarMap[str, float]
    probability_sprung: AtEnds
    probability_giving: AtEnds
    springs_believed: float
    ei_level: Parameter
    ei_thirds: Thirds
    probability_torsion: float
    def __init__(self, f1_hz: _Optional[_Union[Parameter, _Mapping]] = ..., max_deflection_m: _Optional[_Union[Parameter, _Mapping]] = ..., probability_below_90_percent_of_baseline: _Optional[_Mapping[str, float]] = ..., probability_sprung: _Optional[_Union[AtEnds, _Mapping]] = ..., probability_giving: _Optional[_Union[AtEnds, _Mapping]] = ..., springs_believed: _Optional[float] = ..., ei_level: _Optional[_Union[Parameter, _Mapping]] = ..., ei_thirds: _Optional[_Union[Thirds, _Mapping]] = ..., probability_torsion: _Optional[float] = ...) -> None: ...

class Coordinate(_message.Message):
    __slots__ = ("name", "location", "scale", "is_log", "absence")
    NAME_FIELD_NUMBER: _ClassVar[int]
    LOCATION_FIELD_NUMBER: _ClassVar[int]
    SCALE_FIELD_NUMBER: _ClassVar[int]
    IS_LOG_FIELD_NUMBER: _ClassVar[int]
    ABSENCE_FIELD_NUMBER: _ClassVar[int]
    name: str
    location: float
    scale: float
    is_log: bool
    absence: float
    def __init__(self, name: _Optional[str] = ..., location: _Optional[float] = ..., scale: _Optional[float] = ..., is_log: _Optional[bool] = ..., absence: _Optional[float] = ...) -> None: ...

class Footprint(_message.Message):
    __slots__ = ("width_m", "twin_distance_m", "length_m", "track_m", "offset_m")
    WIDTH_M_FIELD_NUMBER: _ClassVar[int]
    TWIN_DISTANCE_M_FIELD_NUMBER: _ClassVar[int]
    LENGTH_M_FIELD_NUMBER: _ClassVar[int]
    TRACK_M_FIELD_NUMBER: _ClassVar[int]
    OFFSET_M_FIELD_NUMBER: _ClassVar[int]
    width_m: float
    twin_distance_m: float
    length_m: float
    track_m: float
    offset_m: float
    def __init__(self, width_m: _Optional[float] = ..., twin_distance_m: _Optional[float] = ..., length_m: _Optional[float] = ..., track_m: _Optional[float] = ..., offset_m: _Optional[float] = ...) -> None: ...

class Stretch(_message.Message):
    __slots__ = ("begin_m", "step_m", "values")
    BEGIN_M_FIELD_NUMBER: _ClassVar[int]
    STEP_M_FIELD_NUMBER: _ClassVar[int]
    VALUES_FIELD_NUMBER: _ClassVar[int]
    begin_m: float
    step_m: float
    values: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, begin_m: _Optional[float] = ..., step_m: _Optional[float] = ..., values: _Optional[_Iterable[float]] = ...) -> None: ...

class Bends(_message.Message):
    __slots__ = ("about", "size", "shapes", "directions", "logarithms")
    ABOUT_FIELD_NUMBER: _ClassVar[int]
    SIZE_FIELD_NUMBER: _ClassVar[int]
    SHAPES_FIELD_NUMBER: _ClassVar[int]
    DIRECTIONS_FIELD_NUMBER: _ClassVar[int]
    LOGARITHMS_FIELD_NUMBER: _ClassVar[int]
    about: _containers.RepeatedScalarFieldContainer[float]
    size: _containers.RepeatedScalarFieldContainer[float]
    shapes: _containers.RepeatedScalarFieldContainer[float]
    directions: _containers.RepeatedScalarFieldContainer[float]
    logarithms: int
    def __init__(self, about: _Optional[_Iterable[float]] = ..., size: _Optional[_Iterable[float]] = ..., shapes: _Optional[_Iterable[float]] = ..., directions: _Optional[_Iterable[float]] = ..., logarithms: _Optional[int] = ...) -> None: ...

class ShortWaves(_message.Message):
    __slots__ = ("step_cycles_per_m", "cosine", "sine")
    STEP_CYCLES_PER_M_FIELD_NUMBER: _ClassVar[int]
    COSINE_FIELD_NUMBER: _ClassVar[int]
    SINE_FIELD_NUMBER: _ClassVar[int]
    step_cycles_per_m: float
    cosine: _containers.RepeatedScalarFieldContainer[float]
    sine: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, step_cycles_per_m: _Optional[float] = ..., cosine: _Optional[_Iterable[float]] = ..., sine: _Optional[_Iterable[float]] = ...) -> None: ...

class FusionLikelihood(_message.Message):
    __slots__ = ("bridge", "truck", "root", "target", "element_lengths_m", "mass_spread", "footprints", "first_knot_m", "knot_spacing_m", "level_m3", "off_bridge_m", "bends", "short_waves")
    BRIDGE_FIELD_NUMBER: _ClassVar[int]
    TRUCK_FIELD_NUMBER: _ClassVar[int]
    ROOT_FIELD_NUMBER: _ClassVar[int]
    TARGET_FIELD_NUMBER: _ClassVar[int]
    ELEMENT_LENGTHS_M_FIELD_NUMBER: _ClassVar[int]
    MASS_SPREAD_FIELD_NUMBER: _ClassVar[int]
    FOOTPRINTS_FIELD_NUMBER: _ClassVar[int]
    FIRST_KNOT_M_FIELD_NUMBER: _ClassVar[int]
    KNOT_SPACING_M_FIELD_NUMBER: _ClassVar[int]
    LEVEL_M3_FIELD_NUMBER: _ClassVar[int]
    OFF_BRIDGE_M_FIELD_NUMBER: _ClassVar[int]
    BENDS_FIELD_NUMBER: _ClassVar[int]
    SHORT_WAVES_FIELD_NUMBER: _ClassVar[int]
    bridge: _containers.RepeatedCompositeFieldContainer[Coordinate]
    truck: _containers.RepeatedCompositeFieldContainer[Coordinate]
    root: _containers.RepeatedScalarFieldContainer[float]
    target: _containers.RepeatedScalarFieldContainer[float]
    element_lengths_m: _containers.RepeatedScalarFieldContainer[float]
    mass_spread: float
    footprints: _containers.RepeatedCompositeFieldContainer[Footprint]
    first_knot_m: float
    knot_spacing_m: float
    level_m3: _containers.RepeatedScalarFieldContainer[float]
    off_bridge_m: _containers.RepeatedCompositeFieldContainer[Stretch]
    bends: Bends
    short_waves: ShortWaves
    def __init__(self, bridge: _Optional[_Iterable[_Union[Coordinate, _Mapping]]] = ..., truck: _Optional[_Iterable[_Union[Coordinate, _Mapping]]] = ..., root: _Optional[_Iterable[float]] = ..., target: _Optional[_Iterable[float]] = ..., element_lengths_m: _Optional[_Iterable[float]] = ..., mass_spread: _Optional[float] = ..., footprints: _Optional[_Iterable[_Union[Footprint, _Mapping]]] = ..., first_knot_m: _Optional[float] = ..., knot_spacing_m: _Optional[float] = ..., level_m3: _Optional[_Iterable[float]] = ..., off_bridge_m: _Optional[_Iterable[_Union[Stretch, _Mapping]]] = ..., bends: _Optional[_Union[Bends, _Mapping]] = ..., short_waves: _Optional[_Union[ShortWaves, _Mapping]] = ...) -> None: ...

class Estimate(_message.Message):
    __slots__ = ("schema_version", "program", "version", "created_ns", "site_hash", "settings_json", "seed", "crossing_id", "realm", "vehicle", "bridge", "direction", "entry_time_ns", "exit_time_ns", "speed_m_per_s", "method", "certificate", "verdict", "reasons", "reason_texts", "chi2_per_dof", "diagnostics", "parameters", "scale_error", "covariance", "derived", "road", "fusion_likelihood", "element_edges_m", "nominal_ei_nm2")
    class DiagnosticsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    class ParametersEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: Parameter
        def __init__(self, key: _Optional[str] = ..., value: _Optional[_Union[Parameter, _Mapping]] = ...) -> None: ...
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    PROGRAM_FIELD_NUMBER: _ClassVar[int]
    VERSION_FIELD_NUMBER: _ClassVar[int]
    CREATED_NS_FIELD_NUMBER: _ClassVar[int]
    SITE_HASH_FIELD_NUMBER: _ClassVar[int]
    SETTINGS_JSON_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    CROSSING_ID_FIELD_NUMBER: _ClassVar[int]
    REALM_FIELD_NUMBER: _ClassVar[int]
    VEHICLE_FIELD_NUMBER: _ClassVar[int]
    BRIDGE_FIELD_NUMBER: _ClassVar[int]
    DIRECTION_FIELD_NUMBER: _ClassVar[int]
    ENTRY_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    EXIT_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    SPEED_M_PER_S_FIELD_NUMBER: _ClassVar[int]
    METHOD_FIELD_NUMBER: _ClassVar[int]
    CERTIFICATE_FIELD_NUMBER: _ClassVar[int]
    VERDICT_FIELD_NUMBER: _ClassVar[int]
    REASONS_FIELD_NUMBER: _ClassVar[int]
    REASON_TEXTS_FIELD_NUMBER: _ClassVar[int]
    CHI2_PER_DOF_FIELD_NUMBER: _ClassVar[int]
    DIAGNOSTICS_FIELD_NUMBER: _ClassVar[int]
    PARAMETERS_FIELD_NUMBER: _ClassVar[int]
    SCALE_ERROR_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    DERIVED_FIELD_NUMBER: _ClassVar[int]
    ROAD_FIELD_NUMBER: _ClassVar[int]
    FUSION_LIKELIHOOD_FIELD_NUMBER: _ClassVar[int]
    ELEMENT_EDGES_M_FIELD_NUMBER: _ClassVar[int]
    NOMINAL_EI_NM2_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    program: str
    version: str
    created_ns: int
    site_hash: str
    settings_json: str
    seed: int
    crossing_id: str
    realm: str
    vehicle: str
    bridge: str
    direction: Direction
    entry_time_ns: int
    exit_time_ns: int
    speed_m_per_s: float
    method: str
    certificate: str
    verdict: Verdict
    reasons: _containers.RepeatedScalarFieldContainer[str]
    reason_texts: _containers.RepeatedScalarFieldContainer[str]
    chi2_per_dof: float
    diagnostics: _containers.ScalarMap[str, float]
    parameters: _containers.MessageMap[str, Parameter]
    scale_error: float
    covariance: Covariance
    derived: Derived
    road: RoadResult
    fusion_likelihood: FusionLikelihood
    element_edges_m: _containers.RepeatedScalarFieldContainer[float]
    nominal_ei_nm2: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, schema_version: _Optional[int] = ..., program: _Optional[str] = ..., version: _Optional[str] = ..., created_ns: _Optional[int] = ..., site_hash: _Optional[str] = ..., settings_json: _Optional[str] = ..., seed: _Optional[int] = ..., crossing_id: _Optional[str] = ..., realm: _Optional[str] = ..., vehicle: _Optional[str] = ..., bridge: _Optional[str] = ..., direction: _Optional[_Union[Direction, str]] = ..., entry_time_ns: _Optional[int] = ..., exit_time_ns: _Optional[int] = ..., speed_m_per_s: _Optional[float] = ..., method: _Optional[str] = ..., certificate: _Optional[str] = ..., verdict: _Optional[_Union[Verdict, str]] = ..., reasons: _Optional[_Iterable[str]] = ..., reason_texts: _Optional[_Iterable[str]] = ..., chi2_per_dof: _Optional[float] = ..., diagnostics: _Optional[_Mapping[str, float]] = ..., parameters: _Optional[_Mapping[str, Parameter]] = ..., scale_error: _Optional[float] = ..., covariance: _Optional[_Union[Covariance, _Mapping]] = ..., derived: _Optional[_Union[Derived, _Mapping]] = ..., road: _Optional[_Union[RoadResult, _Mapping]] = ..., fusion_likelihood: _Optional[_Union[FusionLikelihood, _Mapping]] = ..., element_edges_m: _Optional[_Iterable[float]] = ..., nominal_ei_nm2: _Optional[_Iterable[float]] = ...) -> None: ...

class ElementState(_message.Message):
    __slots__ = ("mean", "std", "q025", "q975")
    MEAN_FIELD_NUMBER: _ClassVar[int]
    STD_FIELD_NUMBER: _ClassVar[int]
    Q025_FIELD_NUMBER: _ClassVar[int]
    Q975_FIELD_NUMBER: _ClassVar[int]
    mean: float
    std: float
    q025: float
    q975: float
    def __init__(self, mean: _Optional[float] = ..., std: _Optional[float] = ..., q025: _Optional[float] = ..., q975: _Optional[float] = ...) -> None: ...

class LeftOut(_message.Message):
    __slots__ = ("crossing_id", "reason")
    CROSSING_ID_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    crossing_id: str
    reason: str
    def __init__(self, crossing_id: _Optional[str] = ..., reason: _Optional[str] = ...) -> None: ...

class BridgeState(_message.Message):
    __slots__ = ("schema_version", "bridge", "time_ns", "flexural_rigidity_nm2", "between_crossing_std", "crossings_used", "crossings_left_out", "crossings_left_out_count", "verdict", "reasons", "reason_texts", "finding", "weakest_element", "probability_of_loss", "level", "left", "middle", "right", "between_crossing_std_q025", "between_crossing_std_q975", "tracks", "element_edges_m", "nominal_ei_nm2")
    class FlexuralRigidityNm2Entry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: ElementState
        def __init__(self, key: _Optional[str] = ..., value: _Optional[_Union[ElementState, _Mapping]] = ...) -> None: ...
    class ProbabilityOfLossEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: Losses
        def __init__(self, key: _Optional[str] = ..., value: _Optional[_Union[Losses, _Mapping]] = ...) -> None: ...
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    BRIDGE_FIELD_NUMBER: _ClassVar[int]
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    FLEXURAL_RIGIDITY_NM2_FIELD_NUMBER: _ClassVar[int]
    BETWEEN_CROSSING_STD_FIELD_NUMBER: _ClassVar[int]
    CROSSINGS_USED_FIELD_NUMBER: _ClassVar[int]
    CROSSINGS_LEFT_OUT_FIELD_NUMBER: _ClassVar[int]
    CROSSINGS_LEFT_OUT_COUNT_FIELD_NUMBER: _ClassVar[int]
    VERDICT_FIELD_NUMBER: _ClassVar[int]
    REASONS_FIELD_NUMBER: _ClassVar[int]
    REASON_TEXTS_FIELD_NUMBER: _ClassVar[int]
    FINDING_FIELD_NUMBER: _ClassVar[int]
    WEAKEST_ELEMENT_FIELD_NUMBER: _ClassVar[int]
    PROBABILITY_OF_LOSS_FIELD_NUMBER: _ClassVar[int]
    LEVEL_FIELD_NUMBER: _ClassVar[int]
    LEFT_FIELD_NUMBER: _ClassVar[int]
    MIDDLE_FIELD_NUMBER: _ClassVar[int]
    RIGHT_FIELD_NUMBER: _ClassVar[int]
    BETWEEN_CROSSING_STD_Q025_FIELD_NUMBER: _ClassVar[int]
    BETWEEN_CROSSING_STD_Q975_FIELD_NUMBER: _ClassVar[int]
    TRACKS_FIELD_NUMBER: _ClassVar[int]
    ELEMENT_EDGES_M_FIELD_NUMBER: _ClassVar[int]
    NOMINAL_EI_NM2_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    bridge: str
    time_ns: int
    flexural_rigidity_nm2: _containers.MessageMap[str, ElementState]
    between_crossing_std: float
    crossings_used: _containers.RepeatedScalarFieldContainer[str]
    crossings_left_out: _containers.RepeatedCompositeFieldContainer[LeftOut]
    crossings_left_out_count: int
    verdict: Verdict
    reasons: _containers.RepeatedScalarFieldContainer[str]
    reason_texts: _containers.RepeatedScalarFieldContainer[str]
    finding: str
    weakest_element: str
    probability_of_loss: _containers.MessageMap[str, Losses]
    level: ElementState
    left: ElementState
    middle: ElementState
    right: ElementState
    between_crossing_std_q025: float
    between_crossing_std_q975: float
    tracks: _containers.RepeatedCompositeFieldContainer[Track]
    element_edges_m: _containers.RepeatedScalarFieldContainer[float]
    nominal_ei_nm2: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, schema_version: _Optional[int] = ..., bridge: _Optional[str] = ..., time_ns: _Optional[int] = ..., flexural_rigidity_nm2: _Optional[_Mapping[str, ElementState]] = ..., between_crossing_std: _Optional[float] = ..., crossings_used: _Optional[_Iterable[str]] = ..., crossings_left_out: _Optional[_Iterable[_Union[LeftOut, _Mapping]]] = ..., crossings_left_out_count: _Optional[int] = ..., verdict: _Optional[_Union[Verdict, str]] = ..., reasons: _Optional[_Iterable[str]] = ..., reason_texts: _Optional[_Iterable[str]] = ..., finding: _Optional[str] = ..., weakest_element: _Optional[str] = ..., probability_of_loss: _Optional[_Mapping[str, Losses]] = ..., level: _Optional[_Union[ElementState, _Mapping]] = ..., left: _Optional[_Union[ElementState, _Mapping]] = ..., middle: _Optional[_Union[ElementState, _Mapping]] = ..., right: _Optional[_Union[ElementState, _Mapping]] = ..., between_crossing_std_q025: _Optional[float] = ..., between_crossing_std_q975: _Optional[float] = ..., tracks: _Optional[_Iterable[_Union[Track, _Mapping]]] = ..., element_edges_m: _Optional[_Iterable[float]] = ..., nominal_ei_nm2: _Optional[_Iterable[float]] = ...) -> None: ...

class Alarm(_message.Message):
    __slots__ = ("schema_version", "time_ns", "bridge", "alarm_id", "element", "is_stiffer", "since_ns", "raised_ns", "sum", "threshold", "ratio", "ratio_q025", "ratio_q975", "text", "is_acknowledged", "acknowledged_by", "acknowledged_ns", "note")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    BRIDGE_FIELD_NUMBER: _ClassVar[int]
    ALARM_ID_FIELD_NUMBER: _ClassVar[int]
    ELEMENT_FIELD_NUMBER: _ClassVar[int]
    IS_STIFFER_FIELD_NUMBER: _ClassVar[int]
    SINCE_NS_FIELD_NUMBER: _ClassVar[int]
    RAISED_NS_FIELD_NUMBER: _ClassVar[int]
    SUM_FIELD_NUMBER: _ClassVar[int]
    THRESHOLD_FIELD_NUMBER: _ClassVar[int]
    RATIO_FIELD_NUMBER: _ClassVar[int]
    RATIO_Q025_FIELD_NUMBER: _ClassVar[int]
    RATIO_Q975_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    IS_ACKNOWLEDGED_FIELD_NUMBER: _ClassVar[int]
    ACKNOWLEDGED_BY_FIELD_NUMBER: _ClassVar[int]
    ACKNOWLEDGED_NS_FIELD_NUMBER: _ClassVar[int]
    NOTE_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    time_ns: int
    bridge: str
    alarm_id: str
    element: int
    is_stiffer: bool
    since_ns: int
    raised_ns: int
    sum: float
    threshold: float
    ratio: float
    ratio_q025: float
    ratio_q975: float
    text: str
    is_acknowledged: bool
    acknowledged_by: str
    acknowledged_ns: int
    note: str
    def __init__(self, schema_version: _Optional[int] = ..., time_ns: _Optional[int] = ..., bridge: _Optional[str] = ..., alarm_id: _Optional[str] = ..., element: _Optional[int] = ..., is_stiffer: _Optional[bool] = ..., since_ns: _Optional[int] = ..., raised_ns: _Optional[int] = ..., sum: _Optional[float] = ..., threshold: _Optional[float] = ..., ratio: _Optional[float] = ..., ratio_q025: _Optional[float] = ..., ratio_q975: _Optional[float] = ..., text: _Optional[str] = ..., is_acknowledged: _Optional[bool] = ..., acknowledged_by: _Optional[str] = ..., acknowledged_ns: _Optional[int] = ..., note: _Optional[str] = ...) -> None: ...

class Losses(_message.Message):
    __slots__ = ("ten", "twenty", "thirty")
    TEN_FIELD_NUMBER: _ClassVar[int]
    TWENTY_FIELD_NUMBER: _ClassVar[int]
    THIRTY_FIELD_NUMBER: _ClassVar[int]
    ten: float
    twenty: float
    thirty: float
    def __init__(self, ten: _Optional[float] = ..., twenty: _Optional[float] = ..., thirty: _Optional[float] = ...) -> None: ...

class Track(_message.Message):
    __slots__ = ("vehicle", "direction", "common_share", "wander_m")
    VEHICLE_FIELD_NUMBER: _ClassVar[int]
    DIRECTION_FIELD_NUMBER: _ClassVar[int]
    COMMON_SHARE_FIELD_NUMBER: _ClassVar[int]
    WANDER_M_FIELD_NUMBER: _ClassVar[int]
    vehicle: str
    direction: Direction
    common_share: float
    wander_m: float
    def __init__(self, vehicle: _Optional[str] = ..., direction: _Optional[_Union[Direction, str]] = ..., common_share: _Optional[float] = ..., wander_m: _Optional[float] = ...) -> None: ...

class Health(_message.Message):
    __slots__ = ("schema_version", "time_ns", "service", "ok", "figures", "note", "ended")
    class FiguresEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    SERVICE_FIELD_NUMBER: _ClassVar[int]
    OK_FIELD_NUMBER: _ClassVar[int]
    FIGURES_FIELD_NUMBER: _ClassVar[int]
    NOTE_FIELD_NUMBER: _ClassVar[int]
    ENDED_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    time_ns: int
    service: str
    ok: bool
    figures: _containers.ScalarMap[str, float]
    note: str
    ended: bool
    def __init__(self, schema_version: _Optional[int] = ..., time_ns: _Optional[int] = ..., service: _Optional[str] = ..., ok: _Optional[bool] = ..., figures: _Optional[_Mapping[str, float]] = ..., note: _Optional[str] = ..., ended: _Optional[bool] = ...) -> None: ...

class Progress(_message.Message):
    __slots__ = ("schema_version", "time_ns", "crossing_id", "stage", "fraction")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    CROSSING_ID_FIELD_NUMBER: _ClassVar[int]
    STAGE_FIELD_NUMBER: _ClassVar[int]
    FRACTION_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    time_ns: int
    crossing_id: str
    stage: str
    fraction: float
    def __init__(self, schema_version: _Optional[int] = ..., time_ns: _Optional[int] = ..., crossing_id: _Optional[str] = ..., stage: _Optional[str] = ..., fraction: _Optional[float] = ...) -> None: ...

class Event(_message.Message):
    __slots__ = ("schema_version", "time_ns", "kind", "vehicle", "stream", "boot_id", "first_sequence", "last_sequence", "count", "text")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    VEHICLE_FIELD_NUMBER: _ClassVar[int]
    STREAM_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    FIRST_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    LAST_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    time_ns: int
    kind: str
    vehicle: str
    stream: str
    boot_id: int
    first_sequence: int
    last_sequence: int
    count: int
    text: str
    def __init__(self, schema_version: _Optional[int] = ..., time_ns: _Optional[int] = ..., kind: _Optional[str] = ..., vehicle: _Optional[str] = ..., stream: _Optional[str] = ..., boot_id: _Optional[int] = ..., first_sequence: _Optional[int] = ..., last_sequence: _Optional[int] = ..., count: _Optional[int] = ..., text: _Optional[str] = ...) -> None: ...

class DurableStream(_message.Message):
    __slots__ = ("owner", "identifier", "stream", "boot_id", "sequence", "count")
    OWNER_FIELD_NUMBER: _ClassVar[int]
    IDENTIFIER_FIELD_NUMBER: _ClassVar[int]
    STREAM_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    owner: str
    identifier: str
    stream: str
    boot_id: int
    sequence: int
    count: int
    def __init__(self, owner: _Optional[str] = ..., identifier: _Optional[str] = ..., stream: _Optional[str] = ..., boot_id: _Optional[int] = ..., sequence: _Optional[int] = ..., count: _Optional[int] = ...) -> None: ...

class Durable(_message.Message):
    __slots__ = ("schema_version", "time_ns", "streams")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    STREAMS_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    time_ns: int
    streams: _containers.RepeatedCompositeFieldContainer[DurableStream]
    def __init__(self, schema_version: _Optional[int] = ..., time_ns: _Optional[int] = ..., streams: _Optional[_Iterable[_Union[DurableStream, _Mapping]]] = ...) -> None: ...

class SequenceRange(_message.Message):
    __slots__ = ("first", "last")
    FIRST_FIELD_NUMBER: _ClassVar[int]
    LAST_FIELD_NUMBER: _ClassVar[int]
    first: int
    last: int
    def __init__(self, first: _Optional[int] = ..., last: _Optional[int] = ...) -> None: ...

class SpoolBoot(_message.Message):
    __slots__ = ("boot_id", "next_sequence", "held", "durable", "dropped")
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    NEXT_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    HELD_FIELD_NUMBER: _ClassVar[int]
    DURABLE_FIELD_NUMBER: _ClassVar[int]
    DROPPED_FIELD_NUMBER: _ClassVar[int]
    boot_id: int
    next_sequence: int
    held: _containers.RepeatedCompositeFieldContainer[SequenceRange]
    durable: int
    dropped: int
    def __init__(self, boot_id: _Optional[int] = ..., next_sequence: _Optional[int] = ..., held: _Optional[_Iterable[_Union[SequenceRange, _Mapping]]] = ..., durable: _Optional[int] = ..., dropped: _Optional[int] = ...) -> None: ...

class SpoolContents(_message.Message):
    __slots__ = ("schema_version", "time_ns", "boots")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    BOOTS_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    time_ns: int
    boots: _containers.RepeatedCompositeFieldContainer[SpoolBoot]
    def __init__(self, schema_version: _Optional[int] = ..., time_ns: _Optional[int] = ..., boots: _Optional[_Iterable[_Union[SpoolBoot, _Mapping]]] = ...) -> None: ...

class SpoolPage(_message.Message):
    __slots__ = ("schema_version", "boot_id", "first", "last", "next")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    FIRST_FIELD_NUMBER: _ClassVar[int]
    LAST_FIELD_NUMBER: _ClassVar[int]
    NEXT_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    boot_id: int
    first: int
    last: int
    next: int
    def __init__(self, schema_version: _Optional[int] = ..., boot_id: _Optional[int] = ..., first: _Optional[int] = ..., last: _Optional[int] = ..., next: _Optional[int] = ...) -> None: ...
