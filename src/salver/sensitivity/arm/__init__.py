"""Effect of parameter errors on the chain of arm, tray and objects that stick to the tray."""

from salver.sensitivity.arm.chain import ArmChain, arm_chain, chain_model

__all__ = ["ArmChain", "arm_chain", "chain_model"]
