"""The arm: its URDF, kinematics, dynamics and limits, and the shapes of its links."""
