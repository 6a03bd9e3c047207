// A C interface to OpenCV's inpainting.
#include <opencv2/photo.hpp>

#include <cstdint>
#include <cstdio>

// Fills `pixels` [height][width][3] where `hole` [height][width] is not 0, from pixels within
// `radius` pixels. Returns 0, or -1 with a zero-terminated reason of at most `reason_size` bytes.
extern "C" int fastlgs_opencv_inpaint(uint8_t *pixels, const uint8_t *hole, int width, int height, float radius, char *reason,
                                      size_t reason_size) {
    try {
        cv::Mat picture(height, width, CV_8UC3, pixels);
        // cv::Mat takes only mutable pointers. The hole is not written to.
        const cv::Mat mask(height, width, CV_8UC1, const_cast<uint8_t *>(hole));
        cv::Mat filled;
        cv::inpaint(picture, mask, filled, radius, cv::INPAINT_TELEA);
        filled.copyTo(picture);
        return 0;
    } catch (const std::exception &error) {
        std::snprintf(reason, reason_size, "%s", error.what());
        return -1;
    }
}
