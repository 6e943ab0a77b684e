"""Where else a run's numbers go: TensorBoard, Weights & Biases, trackio, MLflow, or your own."""
