"""Few-shot teaching: some touches of each class, on any sensor, become a model, on the robot.

    Source --> Classifier(features.onnx) --> Lesson --> model.onnx     (`tactile-rt teach`)

`lesson` keeps touches and what each was; `features` and `head` are what is learnt with; `model` and
`onnx_bytes` write the file, that of a network with enrolled objects too; `teacher` and `page` lead
whoever touches. Nothing here needs torch, or the package onnx.
"""
