"""Where figures come from: `tactile-rt bench` and `tactile-rt eval`."""
