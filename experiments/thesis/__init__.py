"""What the case studies of the thesis share: the craft, its operator, its measurements."""
