"""Load dynamics (a liquid, a pendulum) along a motion: state, reaction wrench, and limits."""
