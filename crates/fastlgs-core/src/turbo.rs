//! Colour maps for heat maps and object ids.

/// Returns the turbo colour (Mikhailov 2019) of `x` in [0, 1], by its author's polynomial.
pub fn turbo(x: f32) -> [u8; 3] {
    let x = f64::from(x.clamp(0.0, 1.0));
    let poly = |c: [f64; 6]| c.iter().rev().fold(0.0, |sum, k| sum * x + k);
    let channel = |c| (poly(c).clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
    [
        channel([
            0.13572138,
            4.61539260,
            -42.66032258,
            132.13108234,
            -152.94239396,
            59.28637943,
        ]),
        channel([
            0.09140261,
            2.19418839,
            4.84296658,
            -14.18503333,
            4.27729857,
            2.82956604,
        ]),
        channel([
            0.10667330,
            12.64194608,
            -60.58204836,
            110.36276771,
            -89.90310912,
            27.34824973,
        ]),
    ]
}

/// Returns a distinct, constant colour for an object id; black for 0.
pub fn id_color(id: u16) -> [u8; 3] {
    if id == 0 {
        return [0; 3];
    }
    // Golden-ratio steps around the hue circle give neighbouring ids different hues.
    let hue = (f32::from(id) * 0.618_034).fract() * 6.0;
    let value = 0.65 + 0.35 * ((f32::from(id) * 0.381_966).fract());
    let ramp = |shift: f32| ((hue + shift).rem_euclid(6.0) - 3.0).abs() - 1.0;
    [0.0, 4.0, 2.0].map(|s| ((0.25 + 0.75 * ramp(s).clamp(0.0, 1.0)) * value * 255.0) as u8)
}

#[cfg(test)]
mod tests {
    #[test]
    fn turbo_runs_from_blue_to_red() {
        let (low, mid, high) = (super::turbo(0.0), super::turbo(0.5), super::turbo(1.0));
        assert!(low[2] > low[1] && mid[1] > 200 && high[0] > high[2] && high[0] > 100);
    }
}
