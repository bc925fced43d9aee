from sb3_eqr.eqr_rainbow.eqr_rainbow import EqRRainbow
from sb3_eqr.eqr_rainbow.policies import CnnPolicy, EqRRainbowPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["CnnPolicy", "EqRRainbow", "EqRRainbowPolicy", "MlpPolicy", "MultiInputPolicy"]
