from sb3_eqr.eqr_qrdqn.eqr_qrdqn import EqRQRDQN
from sb3_eqr.eqr_qrdqn.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["CnnPolicy", "EqRQRDQN", "MlpPolicy", "MultiInputPolicy"]
