// OpenCV's inpainting behind one plain function.
#include <opencv2/photo.hpp>

#include <cstdint>
#include <cstdio>

// Fills `pixels` (three bytes each) where `hole` is not 0. Returns 0, or -1 with a reason in `reason`.
extern "C" int fastlgs_opencv_inpaint(uint8_t *pixels, const uint8_t *hole, int width, int height, float radius, char *reason,
                                      size_t reason_size) {
    try {
        cv::Mat picture(height, width, CV_8UC3, pixels);
        // OpenCV takes no pictures that cannot be written to, but does not write here.
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
