from sb3_eqr.eqr_sac.eqr_sac import EqRSAC
from sb3_eqr.eqr_sac.policies import CnnPolicy, EqRSACPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["CnnPolicy", "EqRSAC", "EqRSACPolicy", "MlpPolicy", "MultiInputPolicy"]
