// A C interface to OpenCV's SIFT. A build needs only OpenCV's headers and a C++ compiler.
#include <opencv2/features2d.hpp>

#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <vector>

// Detects the `most` strongest key points of the grey picture `pixels` [height][width], and those
// that are as strong as the last of them. Writes at most `capacity` of them: `positions`
// [capacity][2] (x, y in OpenCV's coordinates, see sift.rs) and `descriptors` [capacity][128].
// Returns their number, or -1 with a zero-terminated reason of at most `reason_size` bytes.
extern "C" int fastlgs_opencv_sift(const uint8_t *pixels, int width, int height, int most, int capacity, float *positions,
                                   uint8_t *descriptors, char *reason, size_t reason_size) {
    try {
        // cv::Mat takes only mutable pointers. The picture is not written to.
        const cv::Mat picture(height, width, CV_8UC1, const_cast<uint8_t *>(pixels));
        // Half of the usual contrast threshold: evenly lit walls have weak corners only.
        const auto sift = cv::SIFT::create(most, 3, 0.02, 10.0, 1.6);
        std::vector<cv::KeyPoint> points;
        cv::Mat values;
        sift->detectAndCompute(picture, cv::noArray(), points, values);
        const int count = std::min<int>(static_cast<int>(points.size()), capacity);
        for (int i = 0; i < count; i++) {
            positions[2 * i] = points[i].pt.x;
            positions[2 * i + 1] = points[i].pt.y;
            const float *row = values.ptr<float>(i);
            for (int k = 0; k < 128; k++) {
                descriptors[128 * i + k] = static_cast<uint8_t>(row[k]);
            }
        }
        return count;
    } catch (const std::exception &error) {
        std::snprintf(reason, reason_size, "%s", error.what());
        return -1;
    }
}
