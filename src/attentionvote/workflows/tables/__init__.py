"""The paper's tables and figures beside ours (`make benchmark`)."""
