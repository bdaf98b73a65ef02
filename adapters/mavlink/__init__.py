"""MAVLink: frames in, sensors out of them, requests, signing, and what is sent to autopilot and ground station."""
