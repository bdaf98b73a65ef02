# The layout of plain memory that the twin and the kernel share, held to the twin at run time by check_layout.

cdef enum:
    VALUES = 8
    PARAMETERS = 16

cdef struct Row:
    int64_t t_ns
    int64_t sequence
    int64_t t_receive_ns
    int32_t source
    int32_t outcome
    double ratio
    double values[VALUES]
    double innovation[3]
    double variance[3]

cdef extern from *:
    """
    typedef double *__restrict__ vector;  /* n numbers that nothing else points to: lets the loops use vector units */
    """
    ctypedef double* vector

cdef struct Noise:
    double accel, gyro, accel_bias, gyro_bias
    double calibrations[n - 15]

# The layout of fusiond.state, as offsets. `check_layout` holds them to it.
cdef enum:
    POSITION_E = 0
    VELOCITY_E = 3
    QUATERNION_EB = 6
    GYRO_BIAS_B = 10
    ACCEL_BIAS_B = 13
    WHEEL_SCALE = 16
    MOUNT = 17
    ANTENNA_B = 22
    DELAYS = 25
    NOMINAL_SIZE = 28
    POSITION = 0
    VELOCITY = 3
    ATTITUDE = 6
    GYRO_BIAS = 9
    ACCEL_BIAS = 12
    SCALE = 15
    MOUNT_ERROR = 16
    CALIBRATIONS = 15
    ANSWER_SIZE = 91
    ANTENNA_ERROR = 21  # from here on only in the wide state
    DELAYS_ERROR = 24
    WIDE_SIZE = 27
    HELD_FORCE_B = 0
    HELD_RATE_B = 3
    FORCE_B = 6
    RATE_B = 9
    MEAN_FORCE_B = 12
    MEAN_RATE_B = 15
    SCATTER_FORCE = 18
    SCATTER_RATE = 19
    MEAN_WEIGHT = 20
    REST_RATE_B = 21
    FIRST_VELOCITY_N = 24
    CONSTRAINT_RATIO = 32
    RATE_VARIANCE = 35
    SMOOTH_FORCE_B = 36
    AUXILIARY_SIZE = 39
    LAST_VALUE = 0
    LAST_RATIO = 1
    NOISE_EXCESS = 2
    NOMINAL = 3
    NOISY = 4
    BIASED = 5
    FROZEN = 6
    BIAS = 7
    BIAS_VARIANCE = 10
    LAST_SUM = 11
    INTERVAL = 12
    LAST_INNOVATION = 13
    MEAN_NIS = 16
    MEMORY_SIZE = 17
    T = 0
    T_IMU = 1
    T_CONSTRAINT = 2
    T_STILL = 3
    T_POSITION = 4
    T_FIRST_VELOCITY = 5
    T_REST = 7
    PHASE = 9
    RESETS = 10
    CONSTRAINT_FUSED = 11
    CONSTRAINT_REJECTED = 14
    BLOWN = 17
    STAMPS_SIZE = 18
    T_LAST = 0
    T_FUSED = 1
    T_REJECTED = 2
    T_JUDGED = 3
    T_ALIKE = 4
    T_BACK = 5
    SOURCE_STAMPS_SIZE = 6
    ALIGNING = 1
    RUNNING = 2
    CHOOSING = 3
    HYPOTHESES = 13
    BLOCK = 1 + NOMINAL_SIZE + n * n  # numbers of a hypothesis: weight, nominal, covariance
    FUSED = 0
    REJECTED = 1
    DUPLICATE = 3
    WAITING = 5
    IMU = -1
    GNSS_POSITION = 0
    GNSS_VELOCITY = 1
    WHEEL_SPEED = 2
    NOISE_LEAST = 8
    NOISE_MOST = 9
    SHARED = 10
    COMPANION = 11
    CLUTTER = 12
    COMPILED = 3  # models that this kernel knows; others stop it, and the twin takes one step

cdef int64_t NEVER = -(<int64_t>1 << 62)

cdef double SEMI_MAJOR = 6378137.0
cdef double FLATTENING = 1 / 298.257223563
cdef double SEMI_MINOR = SEMI_MAJOR * (1 - FLATTENING)
cdef double ECCENTRICITY2 = FLATTENING * (2 - FLATTENING)
cdef double SECOND_ECCENTRICITY2 = ECCENTRICITY2 / (1 - ECCENTRICITY2)
cdef double EARTH_RATE = 7.292115e-5
cdef double GRAVITATIONAL_CONSTANT = 3.986004418e14
cdef double EQUATOR_GRAVITY = 9.7803253359
cdef double SOMIGLIANA = 0.00193185265241
cdef double GRAVITY_RATIO = _GRAVITY_RATIO
cdef double COAST_ACCEL2 = strapdown.COAST_ACCEL * strapdown.COAST_ACCEL
cdef double COAST_TURN2 = strapdown.COAST_TURN * strapdown.COAST_TURN
cdef double COAST_TILT2 = strapdown.COAST_TILT * strapdown.COAST_TILT
cdef double COAST_RATE2 = strapdown.COAST_RATE * strapdown.COAST_RATE
cdef double LONGEST_STEP = strapdown.LONGEST_STEP
cdef double OWN_SCATTER = motion_constraints.OWN_SCATTER
cdef double LEAST_SPAN = step.LEAST_SPAN
cdef double LOST_HEADING2 = step.LOST_HEADING * step.LOST_HEADING
cdef double SMOOTH_TIME = motion_constraints.SMOOTH_TIME
cdef double MEAN_TIME = motion_constraints.MEAN_TIME
cdef double MEAN_FILLED = motion_constraints.MEAN_FILLED
cdef int64_t WHEEL_FRESH_NS = motion_constraints.WHEEL_FRESH_NS
cdef int64_t WINDOW_MOST_NS = initial_alignment.WINDOW_MOST_NS
cdef double LEAST_TRACK_SPEED = wheel_speed.LEAST_TRACK_SPEED
cdef double SURE_SPEED = wheel_speed.SURE_SPEED
cdef double DIRECTION_ALIKE = wheel_speed.DIRECTION_ALIKE
cdef int64_t GNSS_FRESH_NS = motion_constraints.GNSS_FRESH_NS
cdef double CARRIED = motion_constraints.CARRIED
cdef double UNIFORM = measurement_update.UNIFORM
cdef double NEGLIGIBLE = measurement_update.NEGLIGIBLE
cdef int64_t BREAK_NS = measurement.BREAK_NS
cdef int64_t OUTAGE_NS = measurement.OUTAGE_NS
cdef int64_t SUSPECT = measurement.SUSPECT
cdef double NEAR = measurement.NEAR
cdef int64_t JUDGE_NS = source_health.JUDGE_NS
cdef double KEEPS = source_health.KEEPS
cdef double PRIOR[4]
PRIOR[:] = source_health.PRIOR
cdef double OUTLIERS = source_health.OUTLIERS
cdef double LEAST_WEIGHT = heading_bank.LEAST_WEIGHT
cdef double BANK_CLUTTER = heading_bank.CLUTTER
cdef double BANK_FAR = heading_bank.FAR
cdef double BANK_DOUBT = heading_bank.DOUBT
cdef double OUTLIER_VARIANCE = source_health.OUTLIER_VARIANCE
cdef double NOISY_VARIANCE = source_health.NOISY_VARIANCE
cdef double FIRST_BIAS_VARIANCE = source_health.FIRST_BIAS_VARIANCE
cdef double BIAS_WALK = source_health.BIAS_WALK
cdef double FARTHEST = source_health.FARTHEST
cdef double LEAST_BIAS = source_health.LEAST_BIAS
cdef double SAME_IF_NOMINAL = source_health.SAME_IF_NOMINAL
cdef double SAME_IF_FAULTY = source_health.SAME_IF_FAULTY
cdef double OTHER_IF_FROZEN = source_health.OTHER_IF_FROZEN
cdef double TELLING = source_health.TELLING
cdef double CHANCE = source_health.CHANCE
cdef double NOTED = source_health.NOTED
cdef double DISTRUST = source_health.DISTRUST
cdef double NOISE_TIME = source_health.NOISE_TIME
cdef double CLIPPED = source_health.CLIPPED
cdef double INTERVAL_SHARE = source_health.INTERVAL_SHARE
cdef double NIS_TIME = source_health.NIS_TIME
cdef double PI = 3.141592653589793
cdef double PI_LOW = portable.PI_LOW
cdef double HALF_PI_HIGH = portable.HALF_PI_HIGH
cdef double HALF_PI_LOW = portable.HALF_PI_LOW
cdef double ATAN[11]
ATAN[:] = portable.ATAN


def check_layout():
    """The offsets above against fusiond.state; an AssertionError names what moved."""
    for name, offset in (
        ("POSITION_E", POSITION_E), ("VELOCITY_E", VELOCITY_E), ("QUATERNION_EB", QUATERNION_EB),
        ("GYRO_BIAS_B", GYRO_BIAS_B), ("ACCEL_BIAS_B", ACCEL_BIAS_B), ("WHEEL_SCALE", WHEEL_SCALE), ("MOUNT", MOUNT),
        ("POSITION", POSITION), ("VELOCITY", VELOCITY), ("ATTITUDE", ATTITUDE), ("GYRO_BIAS", GYRO_BIAS),
        ("ACCEL_BIAS", ACCEL_BIAS), ("SCALE", SCALE), ("MOUNT_ERROR", MOUNT_ERROR), ("HELD_FORCE_B", HELD_FORCE_B),
        ("HELD_RATE_B", HELD_RATE_B), ("FORCE_B", FORCE_B), ("RATE_B", RATE_B), ("MEAN_FORCE_B", MEAN_FORCE_B),
        ("MEAN_RATE_B", MEAN_RATE_B), ("CONSTRAINT_RATIO", CONSTRAINT_RATIO), ("CONSTRAINT_FUSED", CONSTRAINT_FUSED),
        ("CONSTRAINT_REJECTED", CONSTRAINT_REJECTED),
        ("BIAS", BIAS), ("LAST_INNOVATION", LAST_INNOVATION), ("BELIEF", NOMINAL), ("ANTENNA_B", ANTENNA_B),
        ("SMOOTH_FORCE_B", SMOOTH_FORCE_B), ("DELAYS", DELAYS), ("ANTENNA_ERROR", ANTENNA_ERROR), ("DELAYS_ERROR",
        DELAYS_ERROR),
        ("REST_RATE_B", REST_RATE_B), ("FIRST_VELOCITY_N", FIRST_VELOCITY_N),
    ):
        assert getattr(layout, name).start == offset, name
    for name, number in (
        ("NOMINAL_SIZE", NOMINAL_SIZE), ("CALIBRATIONS", CALIBRATIONS), ("WIDE_SIZE", WIDE_SIZE), ("SCATTER_FORCE",
        SCATTER_FORCE), ("SCATTER_RATE", SCATTER_RATE),
        ("MEAN_WEIGHT", MEAN_WEIGHT), ("RATE_VARIANCE", RATE_VARIANCE), ("AUXILIARY_SIZE", AUXILIARY_SIZE),
        ("LAST_VALUE", LAST_VALUE),
        ("LAST_RATIO", LAST_RATIO), ("NOISE_EXCESS", NOISE_EXCESS), ("NOMINAL", NOMINAL), ("NOISY", NOISY),
        ("BIASED", BIASED), ("FROZEN", FROZEN), ("BIAS_VARIANCE", BIAS_VARIANCE), ("LAST_SUM", LAST_SUM),
        ("INTERVAL", INTERVAL), ("MEAN_NIS", MEAN_NIS), ("T_JUDGED", T_JUDGED), ("T_ALIKE", T_ALIKE), ("T_BACK",
        T_BACK), ("MEMORY_SIZE", MEMORY_SIZE), ("T", T), ("T_IMU", T_IMU),
        ("T_CONSTRAINT", T_CONSTRAINT), ("T_STILL", T_STILL), ("T_POSITION", T_POSITION),
        ("T_FIRST_VELOCITY", T_FIRST_VELOCITY), ("T_REST", T_REST), ("ALIGNING", ALIGNING), ("PHASE", PHASE),
        ("RESETS", RESETS), ("BLOWN", BLOWN), ("STAMPS_SIZE", STAMPS_SIZE), ("T_LAST", T_LAST), ("T_FUSED", T_FUSED),
        ("T_REJECTED", T_REJECTED), ("SOURCE_STAMPS_SIZE", SOURCE_STAMPS_SIZE), ("RUNNING", RUNNING), ("CHOOSING",
        CHOOSING), ("HYPOTHESES", HYPOTHESES), ("NEVER", NEVER),
    ):
        assert getattr(layout, name) == number, name
    assert [model.name for model in observations.MODELS[:COMPILED]] == ["gnss_position", "gnss_velocity", "wheel_speed"]
    for name, number in (
        ("NOISE_LEAST", NOISE_LEAST), ("NOISE_MOST", NOISE_MOST), ("SHARED", SHARED), ("COMPANION", COMPANION),
        ("CLUTTER", CLUTTER), ("PARAMETERS", PARAMETERS), ("VALUES", VALUES),
    ):
        assert getattr(observations.model, name) == number, name
    assert north_east_down.ANSWER_SIZE == ANSWER_SIZE
    assert (Outcome.FUSED, Outcome.REJECTED) == (FUSED, REJECTED)
    assert (Outcome.DUPLICATE, Outcome.WAITING) == (DUPLICATE, WAITING)
