# Made by tools/translate_kernel from fusiond/filter and fusiond/maths: not to be edited. `n`: number of error states.

cdef enum:
    NOMINAL_SIZE = 39
    AUXILIARY_SIZE = 86
    MEMORY_SIZE = 24
    STAMPS_SIZE = 24
    SOURCE_STAMPS_SIZE = 5
    HYPOTHESES = 13
    CALIBRATIONS = 15
    WIDE_SIZE = 37
    PHASE = 10
    CHOOSING = 3
    ALIVE = 22
    T = 0
    VALUES = 8
    PARAMETERS = 16
    IMU = -1
    STATE_N_SIZE = 91
    PARTS = 3
    LINKS = 4
    BLOCK = 1 + NOMINAL_SIZE + n * n  # numbers of a hypothesis: weight, nominal, covariance

cdef struct Noise:
    double accel
    double gyro
    double accel_bias
    double gyro_bias
    double calibrations[(n - CALIBRATIONS)]

cdef struct Observation:
    int64_t m
    double innovation[3]
    double jacobian[2 * n + WIDE_SIZE]
    double variance[3]
    double common[3]

cdef struct Link:
    int64_t row
    int64_t part
    int64_t m
    bint fused
    double weight
    double innovation[3]
    double variance[3]
    double spread[3 * 3]
    double sight[3 * n]
    double across[3 * n]
    double gain[3 * n]
    double transition[n * n]

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

cdef struct State:
    double* nominal
    double* covariance
    double* auxiliary
    double* memory
    double* bank
    int64_t* stamps
    int64_t* source_stamps
    int64_t size
    int64_t sources
    double* transition
    bint tracked

cdef struct Parameters:
    Noise noise
    int64_t* models
    int64_t models_count
    int64_t* wheels
    int64_t wheels_count
    int64_t* velocities
    int64_t velocities_count
    double* model_parameters
    double* constraints
    double gates[4]
    int64_t imu_source
    int64_t imu_gap_ns
    int64_t restart_gap_ns
    int64_t constraint_interval_ns
    int64_t still_after_ns
    int64_t snapshot_interval_ns
    bint standstill
    bint non_holonomic
    double course_speed
    double still_wheel
    double still_gyro
    double still_accel
    double zero_velocity_factor
    double heading_variance
    double spoof_cost
    int64_t estimate
    double dead_reckoning_cost


cdef int load_scalars(Parameters* loaded, params) except -1:
    """The numbers of fusiond.filter.parameters.Parameters."""
    loaded.imu_source = params.imu_source
    loaded.imu_gap_ns = params.imu_gap_ns
    loaded.restart_gap_ns = params.restart_gap_ns
    loaded.constraint_interval_ns = params.constraint_interval_ns
    loaded.still_after_ns = params.still_after_ns
    loaded.snapshot_interval_ns = params.snapshot_interval_ns
    loaded.standstill = params.standstill
    loaded.non_holonomic = params.non_holonomic
    loaded.course_speed = params.course_speed
    loaded.still_wheel = params.still_wheel
    loaded.still_gyro = params.still_gyro
    loaded.still_accel = params.still_accel
    loaded.zero_velocity_factor = params.zero_velocity_factor
    loaded.heading_variance = params.heading_variance
    loaded.spoof_cost = params.spoof_cost
    loaded.estimate = params.estimate
    loaded.dead_reckoning_cost = params.dead_reckoning_cost
    return 0
