//! Time and stated error, written into a picture.

use crate::run::FrameRecord;
use plotters::prelude::*;
use plotters::style::{FontStyle, register_font};

/// Font that is built in, so that pictures look the same on every machine.
const FONT: &str = "sans-serif";

/// Draws a line of text in the lower left corner, on a dark ground: date or time, and the error that the frame states. `rgb` are the rows of a picture
/// of `width` x `height` pixels, from the top.
///
/// # Errors
/// The font is not read, or plotters fails.
pub(super) fn annotate(rgb: &mut [u8], [width, height]: [usize; 2], record: &FrameRecord) -> Result<(), String> {
    register_font(FONT, FontStyle::Normal, epaint_default_fonts::UBUNTU_LIGHT).map_err(|_| "the built-in font is not read".to_owned())?;
    let words = words(record);
    let failed = |error: &dyn std::fmt::Display| format!("the text cannot be drawn: {error}");
    let area = BitMapBackend::with_buffer(rgb, (width as u32, height as u32)).into_drawing_area();
    let font = |size: f64| (FONT, size).into_font().color(&WHITE);
    // A thirtieth of the height, legible and within the width.
    let mut size = (height as f64 / 30.0).clamp(11.0, 60.0);
    let (wide, _) = area.estimate_text_size(&words, &font(size)).map_err(|e| failed(&e))?;
    size *= (width as f64 * 0.95 / f64::from(wide.max(1))).min(1.0);
    let (wide, high) = area.estimate_text_size(&words, &font(size)).map_err(|e| failed(&e))?;
    let (wide, high, margin) = (wide as i32, high as i32, (size / 2.0) as i32);
    let top = height as i32 - high - 2 * margin;
    let ground = Rectangle::new([(0, top), (wide + 2 * margin, height as i32)], BLACK.mix(0.6).filled());
    area.draw(&ground).map_err(|e| failed(&e))?;
    area.draw_text(&words, &font(size), (margin, top + margin)).map_err(|e| failed(&e))?;
    area.present().map_err(|e| failed(&e))
}

/// `2002-01-11T00:00:00Z   error 0.0064 rms, 41.2 dB`.
fn words(record: &FrameRecord) -> String {
    let unit = if record.time_unit.is_empty() { String::new() } else { format!(" {}", record.time_unit) };
    // Without the digits that sums of steps leave.
    let mut text = record.date.clone().unwrap_or_else(|| format!("t = {}{unit}", (record.time * 1e6).round() / 1e6));
    if let Some(error) = &record.picture_error {
        text += &format!("   error {:.4} rms, {:.1} dB", error.rms.value, error.psnr.value);
    } else if let Some(error) = &record.trusted_error {
        text += &format!("   error where trusted {:.4} rms", error.optical_rms);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_text_is_in_the_lower_left_corner_and_leaves_the_rest() {
        let (size, record) = ([320, 160], FrameRecord { time: 2.5, time_unit: "s".into(), ..FrameRecord::default() });
        let mut rgb = vec![100; 320 * 160 * 3];
        annotate(&mut rgb, size, &record).unwrap();
        let rows = |from: usize, to: usize| &rgb[from * 320 * 3..to * 320 * 3];
        assert!(rows(0, 130).iter().all(|&c| c == 100), "above it nothing changes");
        assert!(rows(140, 160).iter().any(|&c| c > 150) && rows(140, 160).iter().any(|&c| c < 60), "light text on a dark ground");
        // Also where there is no room.
        annotate(&mut [0; 27], [3, 3], &record).unwrap();
        assert_eq!(words(&record), "t = 2.5 s");
    }
}
