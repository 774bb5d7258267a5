"""Other people's networks: ONNX files, CLIP and SigLIP."""
