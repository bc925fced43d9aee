from sb3_eqr.eqr_tqc.eqr_tqc import EqRTQC
from sb3_eqr.eqr_tqc.policies import CnnPolicy, EqRTQCPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["CnnPolicy", "EqRTQC", "EqRTQCPolicy", "MlpPolicy", "MultiInputPolicy"]
