"""What a laboratory does round the tracker: cast a phantom, calibrate, record, scan it again."""
