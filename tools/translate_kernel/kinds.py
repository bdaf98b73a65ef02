"""What an expression of the filter's functions can be, by its annotation or field, and what that is in C."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Kind:
    """What an expression is. `name`: "int", "float", "bool", "vector" (numbers `stride` apart), "matrix" (rows of
    `columns`), "pointer" (to a struct, perhaps none), "struct" (one on the stack), "tuple", "none". Sizes are C code."""

    name: str
    of: str = "double"  # C type of an element, or the struct's name
    size: str = ""  # elements of a vector, rows of a matrix; empty: not known
    columns: str = ""
    stride: str = "1"
    items: tuple[Kind, ...] = ()

    @property
    def is_scalar(self) -> bool:
        return self.name in ("int", "float", "bool")

    @property
    def c(self) -> str:
        """Its C type as a parameter or variable."""
        if self.is_scalar:
            return {"int": "int64_t", "float": "double", "bool": "bint"}[self.name]
        if self.name in ("vector", "matrix", "pointer"):
            return f"{self.of}*"
        if self.name == "tuple":
            return f"({', '.join(item.c for item in self.items)})"
        return {"none": "void", "struct": self.of}[self.name]


INT, FLOAT, BOOL, NONE = Kind("int"), Kind("float"), Kind("bool"), Kind("none")


def vector(size: str = "", of: str = "double", stride: str = "1") -> Kind:
    return Kind("vector", of, size, stride=stride)


def matrix(rows: str, columns: str, of: str = "double") -> Kind:
    return Kind("matrix", of, rows, columns)


def size_of(kind: Kind) -> str:
    return f"{kind.size} * {kind.columns}" if kind.name == "matrix" else kind.size


KINDS = {  # annotations
    "int": INT,
    "float": FLOAT,
    "bool": BOOL,
    "None": NONE,
    "Vector": vector(),
    "Vector3": vector("3"),
    "Quaternion": vector("4"),
    "Matrix3": matrix("3", "3"),
    "ErrorVector": vector("n"),
    "ErrorRows3": matrix("3", "n"),
    "ErrorRows6": matrix("6", "n"),
    "ErrorRows9": matrix("9", "n"),
    "Covariance": matrix("n", "n"),
    "Transition": matrix("n", "n"),
    "StateN": vector("STATE_N_SIZE"),
    "Stamps": vector(of="int64_t"),
    "FilterState": Kind("pointer", "State"),
    "Parameters": Kind("pointer", "Parameters"),
    "ProcessNoise": Kind("pointer", "Noise"),
    "Observation": Kind("pointer", "Observation"),
    "Row": Kind("pointer", "Row"),
    "Row | None": Kind("pointer", "Row"),
    "Rows": Kind("pointer", "Row", size="rows"),
    "Link": Kind("pointer", "Link"),
    "Links": Kind("pointer", "Link", size="rows"),
}
FIELDS: dict[str, dict[str, Kind]] = {  # of the structs
    "State": {
        "nominal": vector("NOMINAL_SIZE"),
        "covariance": matrix("n", "n"),
        "auxiliary": vector("AUXILIARY_SIZE"),
        "memory": matrix("", "MEMORY_SIZE"),
        "bank": matrix("HYPOTHESES", "BLOCK"),
        "stamps": vector("STAMPS_SIZE", "int64_t"),
        "source_stamps": matrix("", "SOURCE_STAMPS_SIZE", "int64_t"),
        "size": INT,
        "sources": INT,
        "transition": matrix("n", "n"),
        "tracked": BOOL,
    },
    "Noise": {
        "accel": FLOAT,
        "gyro": FLOAT,
        "accel_bias": FLOAT,
        "gyro_bias": FLOAT,
        "calibrations": vector("(n - CALIBRATIONS)"),
    },
    "Observation": {
        "m": INT,
        "innovation": vector("3"),
        "jacobian": matrix("3", "n"),
        "variance": vector("3"),
        "common": vector("3"),
    },
    "Link": {
        "row": INT,
        "part": INT,
        "m": INT,
        "fused": BOOL,
        "weight": FLOAT,
        "innovation": vector("3"),
        "variance": vector("3"),
        "spread": matrix("3", "3"),
        "sight": matrix("3", "n"),
        "across": matrix("3", "n"),
        "gain": matrix("3", "n"),
        "transition": matrix("n", "n"),
    },
    "Row": {
        "t_ns": INT,
        "sequence": INT,
        "t_receive_ns": INT,
        "source": INT,
        "outcome": INT,
        "ratio": FLOAT,
        "values": vector("VALUES"),
        "innovation": vector("3"),
        "variance": vector("3"),
    },
    "Parameters": {
        "noise": Kind("struct", "Noise"),
        "models": vector("", "int64_t"),
        "wheels": vector("", "int64_t"),
        "velocities": vector("", "int64_t"),
        "model_parameters": matrix("", "PARAMETERS"),
        "constraints": matrix("3", "PARAMETERS"),
        "gates": vector("4"),
        "imu_source": INT,
        "imu_gap_ns": INT,
        "restart_gap_ns": INT,
        "constraint_interval_ns": INT,
        "still_after_ns": INT,
        "snapshot_interval_ns": INT,
        "standstill": BOOL,
        "non_holonomic": BOOL,
        "course_speed": FLOAT,
        "still_wheel": FLOAT,
        "still_gyro": FLOAT,
        "still_accel": FLOAT,
        "zero_velocity_factor": FLOAT,
        "heading_variance": FLOAT,
        "spoof_cost": FLOAT,
        "estimate": INT,
        "dead_reckoning_cost": FLOAT,
    },
}
COUNTED = {"models", "wheels", "velocities"}  # of Parameters: lists whose length is a field as well
