"""Intrinsics of a camera from views of a board, with their uncertainty.

The steps, one module each:

- `board_detection`, `corners`: corners of a ChArUco board or a checkerboard in the raw mosaic, to hundredths of a
  pixel;
- `pinhole`: the camera model of OpenCV and its Jacobian; `bundle_adjustment`: one least-squares solve for intrinsics,
  poses and the warp of the boards, whose Jacobian and residuals give the full covariance;
- `calibration`: outlying corners and views are left out, with the reason;
- `distortion_model`: the model is chosen by views that its fit has not seen. A richer model is refused where it
  predicts them worse;
- `correlated_errors`: errors that neighbouring corners share, from the residuals. They are an error of the model, and
  part of the covariance;
- `cross_validation`: two halves of the views are calibrated separately. What they differ by beyond their uncertainties
  widens the covariance;
- `projection_errors`: the uncertainty of the projection over the frame, and the difference of two calibrations;
- `lateral_colour`: corners and distortion of each colour of a mosaic;
- `recordings`: the step on a recording set, and its result.
"""
