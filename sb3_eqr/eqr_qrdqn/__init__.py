from sb3_eqr.eqr_qrdqn.eqr_qrdqn import EqRQRDQN
from sb3_eqr.eqr_qrdqn.policies import CnnPolicy, EqRQRDQNPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["CnnPolicy", "EqRQRDQN", "EqRQRDQNPolicy", "MlpPolicy", "MultiInputPolicy"]
