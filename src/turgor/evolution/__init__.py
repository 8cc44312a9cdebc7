"""Evolution: strategies that propose controllers, and the loop that has them simulated."""

# The built-in strategies: name -> module and class. No NumPy in here, so that help can list the names at once.
STRATEGIES = {
    "cma-es": ("turgor.evolution.cma_es", "CMAES"),
    "sep-cma-es": ("turgor.evolution.sep_cma_es", "SepCMAES"),
    "lm-ma-es": ("turgor.evolution.lm_ma_es", "LMMAES"),
    "openai-es": ("turgor.evolution.openai_es", "OpenAIES"),
}
