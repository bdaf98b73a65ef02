"""MAVLink: frames to events of sensors, requests, signing, and outputs to the autopilot and a ground station."""
