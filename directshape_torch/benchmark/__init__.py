"""How long refinements take and what memory they need: suites of measurements, baselines of ratios, profiles."""
