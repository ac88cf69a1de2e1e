"""Few-shot teaching: a few touches of each class, on any sensor, become a model on the robot.

    Source --> Classifier(features.onnx) --> Lesson --> model.onnx     (`tactile-rt teach`)

`lesson` stores touches with labels; `features` computes features and `head` learns classes;
`model` and `onnx_bytes` write the file, also of a network with enrolled objects; `teacher` and
`page` guide the user. Nothing here needs torch, or the package onnx.
"""
