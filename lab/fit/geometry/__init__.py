"""Intrinsics of a camera from views of a board, with their uncertainty.

- `board_detection`: corners of a ChArUco board or a checkerboard in the raw mosaic, to hundredths of a pixel;
- `pinhole`: the camera model of OpenCV and its Jacobian, the uncertainty of the projection over the frame, and the
  difference of two calibrations;
- `bundle_adjustment`: one least-squares solve for intrinsics, poses and the warp of the boards, whose Jacobian and
  residuals give the full covariance. Errors that neighbouring corners share are an error of the model, and part of it;
- `calibration`: outlying corners and views are left out, with the reason. The distortion model is chosen by views that
  its fit has not seen: a richer model is refused where it predicts them worse. Two halves of the views are calibrated
  separately; what they differ by beyond their uncertainties widens the covariance;
- `recordings`: the step on a recording set, and its result; corners and distortion of each colour of a mosaic.
"""
