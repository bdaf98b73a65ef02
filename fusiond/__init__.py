"""fusiond: vehicle telemetry fusion (IMU, GNSS, wheel speeds) in an asynchronous error-state Kalman filter.

Glossary, valid in every module:

Frames
    b   body: the IMU's axes, forward-right-down, origin at the IMU
    v   vehicle: forward-right-down along the wheels; rotated against b by the mount misalignment (pitch, yaw)
    n   navigation: local north-east-down at the present position
    e   earth: WGS-84 earth-centred, earth-fixed
Names
    mat_nb          (3, 3) rotation that takes a vector in b to n: vector_n = mat_nb @ vector_b
    velocity_n      a vector resolved in n; velocity is always that of the IMU over ground
    quaternion_nb   (w, x, y, z), unit, body to navigation
    error           the filter's error state; attitude errors are small rotations in e: mat_eb_true = exp([phi]x) mat_eb
    innovation      measurement minus prediction, d = z - h(x)
    variance        sigma squared; a `sigma` is one standard deviation per axis
Units
    SI and radians inside. Only what is not SI has a suffix: `_deg`, `_ms` in the configuration, `_ns` on stamps.
    Time is an integer of nanoseconds on one time line, that of the receiving host (`t_ns`), never a float.
"""

__version__ = "0.1.0"
