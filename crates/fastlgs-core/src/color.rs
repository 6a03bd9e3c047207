//! Conversion of colours from sRGB to CIE Lab.

/// Converts 8-bit sRGB to CIE Lab (white point D65).
pub fn lab(rgb: [u8; 3]) -> [f32; 3] {
    let linear = rgb.map(|v| {
        let v = f32::from(v) / 255.0;
        if v <= 0.04045 {
            v / 12.92
        } else {
            ((v + 0.055) / 1.055).powf(2.4)
        }
    });
    let [r, g, b] = linear;
    let f = |t: f32| {
        if t > 0.008_856 {
            t.cbrt()
        } else {
            7.787 * t + 16.0 / 116.0
        }
    };
    let x = f((0.4124 * r + 0.3576 * g + 0.1805 * b) / 0.9505);
    let y = f(0.2126 * r + 0.7152 * g + 0.0722 * b);
    let z = f((0.0193 * r + 0.1192 * g + 0.9505 * b) / 1.089);
    [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)]
}

#[cfg(test)]
mod tests {
    use super::lab;

    #[test]
    fn known_colours() {
        let near = |rgb: [u8; 3], expected: [f32; 3]| {
            lab(rgb)
                .iter()
                .zip(expected)
                .all(|(a, b)| (a - b).abs() < 0.6)
        };
        assert!(near([255, 255, 255], [100.0, 0.0, 0.0]));
        assert!(near([0, 0, 0], [0.0, 0.0, 0.0]));
        assert!(near([255, 0, 0], [53.2, 80.1, 67.2]));
    }
}
