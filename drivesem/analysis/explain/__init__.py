"""Why a counterexample fails, and how little of it is enough: shares by parameter and car, the least change."""
