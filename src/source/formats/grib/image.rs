//! Values that are packed by a codec of images or of signals: JPEG 2000, PNG and CCSDS. What an image declares is checked before it is unpacked.

use super::super::limits::Limits;
use super::message::unsigned;
use super::packing::Bits;
use hayro_jpeg2000::{DecodeSettings, DecoderContext, Image};

/// Memory of the decoder of JPEG 2000 for a value, a block of values, and a layer of a block.
const VALUE_BYTES: u64 = 32;
const BLOCK_BYTES: u64 = 512;
const LAYER_BYTES: u64 = 32;

/// Template 5.40.
///
/// # Errors
/// Another number of values, an image of several parts or colours, damage.
pub fn jpeg2000(data: &[u8], count: usize, limits: &Limits) -> Result<Vec<u32>, String> {
    let failed = |what: String| format!("JPEG 2000: {what}");
    let bytes = memory_of(data, count).map_err(failed)?;
    limits.check(bytes, &format!("{count} values packed as JPEG 2000"))?;
    let image = Image::new(data, &DecodeSettings::default()).map_err(|e| failed(e.to_string()))?;
    let mut context = DecoderContext::default();
    let decoded = image.decode(&mut context).map_err(|e| failed(e.to_string()))?;
    match decoded.components() {
        [only] => Ok(only.samples().iter().map(|&sample| sample.round() as u32).collect()),
        other => Err(failed(format!("it has {} components, not one", other.len()))),
    }
}

/// The memory that a code stream takes to unpack. Accepted are those of one tile and one component whose structure the main header
/// gives: this is what encoders of GRIB write, and others could declare structures that take far more memory than their values.
/// Source: ISO/IEC 15444-1, annex A.
fn memory_of(data: &[u8], count: usize) -> Result<u64, String> {
    let short = || "it ends within its header".to_owned();
    let get = |at: usize, bytes: usize| data.get(at..at.saturating_add(bytes)).ok_or_else(short);
    let number = |at: usize, bytes: usize| get(at, bytes).map(unsigned);
    if get(0, 4)? != [0xff, 0x4f, 0xff, 0x51] {
        return Err("it is no code stream".into());
    }
    let [width, height] = [number(8, 4)?, number(12, 4)?];
    let tiles = number(24, 4)? >= width && number(28, 4)? >= height;
    let (offsets, components, depth) = ([16, 20, 32, 36].map(|at| number(at, 4)), number(40, 2)?, number(42, 1)?);
    if offsets.iter().any(|offset| *offset != Ok(0)) || !tiles || components != 1 || depth > 31 || number(43, 2)? != 0x0101 {
        return Err("it has several tiles or components, an offset, or signs".into());
    }
    if u64::from(width) * u64::from(height) != count as u64 {
        return Err(format!("it has {width} x {height} values, not {count}"));
    }
    let mut structure = None;
    let mut at = 4 + number(4, 2)? as usize;
    loop {
        let length = number(at + 2, 2)? as usize;
        match number(at, 2)? {
            // Of layers and blocks; the first bit says that precincts of their own sizes follow.
            0xff52 if structure.is_none() && number(at + 4, 1)? & 1 == 0 => {
                structure = Some((number(at + 6, 2)?, number(at + 10, 1)? + number(at + 11, 1)? + 4));
            }
            // Quantisation and comments.
            0xff5c | 0xff64 => {}
            // The only tile, with its data behind its header.
            0xff90 if number(at + 12, 2)? == 0xff93 => break,
            marker => return Err(format!("its marker {marker:04x} is not understood here")),
        }
        if length < 2 {
            return Err("a part of its header has no length".into());
        }
        at += 2 + length;
    }
    let (layers, area) = structure.ok_or_else(short)?;
    // Each of up to 33 resolutions begins blocks of its own.
    let blocks = (count as u64 >> area.min(12)) + 2 * u64::from(width.max(height)) + 256;
    Ok(count as u64 * VALUE_BYTES + blocks * (BLOCK_BYTES + LAYER_BYTES * u64::from(layers)))
}

/// Template 5.41. The depth is that of the image: some encoders write whole bytes and state fewer bits.
///
/// # Errors
/// Another number of values, or damage.
pub fn png(data: &[u8], count: usize) -> Result<Vec<u32>, String> {
    let failed = |what: String| format!("PNG: {what}");
    let mut reader = png::Decoder::new(std::io::Cursor::new(data)).read_info().map_err(|e| failed(e.to_string()))?;
    let (width, height) = reader.info().size();
    let (colour, depth) = reader.output_color_type();
    let bits = colour.samples() as u32 * depth as u32;
    if u64::from(width) * u64::from(height) != count as u64 || bits > 32 {
        return Err(failed(format!("it has {width} x {height} values of {bits} bits; expected are {count} of up to 32 bits")));
    }
    let mut values = Vec::with_capacity(count);
    while let Some(row) = reader.next_row().map_err(|e| failed(e.to_string()))? {
        let mut bits_of_row = Bits::new(row.data());
        values.extend((0..width).map(|_| bits_of_row.take(bits)));
        if values.len() > count {
            return Err(failed("it has more rows than it says".into()));
        }
    }
    Ok(values)
}

/// Template 5.42: CCSDS 121.0-B-3, numbers of `bits` bits in blocks, with a number as it is at each `interval` of blocks.
///
/// # Errors
/// Damage.
pub fn ccsds(data: &[u8], count: usize, bits: u8, flags: u8, block: u32, interval: u32) -> Result<Vec<u32>, String> {
    use rust_aec::{AecFlags, AecParams, decode, flags_from_grib2_ccsds_flags};
    // These flags tell in which form a decoder should give the numbers, not how they are packed.
    let flags = flags_from_grib2_ccsds_flags(flags) | AecFlags::MSB | AecFlags::DATA_3BYTE;
    if flags.contains(AecFlags::DATA_SIGNED) {
        return Err("CCSDS: its numbers have signs".into());
    }
    let bytes = decode(data, AecParams::new(bits, block, interval, flags), count).map_err(|e| format!("CCSDS: {e}"))?;
    Ok(bytes.chunks(usize::from(bits).div_ceil(8)).map(unsigned).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use png::{BitDepth, ColorType};

    #[test]
    fn images_of_all_depths() {
        let depths = [
            (ColorType::Grayscale, BitDepth::One),
            (ColorType::Grayscale, BitDepth::Two),
            (ColorType::Grayscale, BitDepth::Four),
            (ColorType::Grayscale, BitDepth::Eight),
            (ColorType::Grayscale, BitDepth::Sixteen),
            (ColorType::Rgb, BitDepth::Eight),
            (ColorType::Rgba, BitDepth::Eight),
        ];
        for (colour, depth) in depths {
            let bits = colour.samples() * depth as usize;
            // Three rows of five values, each row of whole bytes.
            let values: Vec<u32> = (0..15u32).map(|k| k.wrapping_mul(0x9e37_79b9) >> (32 - bits)).collect();
            let mut rows = Vec::new();
            for row in values.chunks(5) {
                let all: Vec<u32> = row.iter().flat_map(|value| (0..bits).rev().map(move |k| value >> k & 1)).collect();
                rows.extend(all.chunks(8).map(|byte| byte.iter().enumerate().fold(0u8, |sum, (k, bit)| sum | (*bit as u8) << (7 - k))));
            }
            let mut image = Vec::new();
            let mut encoder = png::Encoder::new(&mut image, 5, 3);
            encoder.set_color(colour);
            encoder.set_depth(depth);
            encoder.write_header().unwrap().write_image_data(&rows).unwrap();
            assert_eq!(png(&image, 15).as_ref(), Ok(&values), "{bits} bits");
            assert!(png(&image, 14).unwrap_err().contains("5 x 3 values"));
            assert!(png(&image[..image.len() / 2], 15).is_err());
        }
    }

    /// The header of a code stream of 6 x 4 values.
    fn header(change: impl Fn(&mut Vec<u8>)) -> Vec<u8> {
        let mut header = vec![0xff, 0x4f, 0xff, 0x51, 0, 41, 0, 0];
        header.extend([6, 4, 0, 0, 6, 4, 0, 0].iter().flat_map(|&size: &u32| size.to_be_bytes()));
        header.extend([0, 1, 11, 1, 1]);
        header.extend([0xff, 0x52, 0, 12, 0, 0, 0, 1, 0, 0, 4, 4, 0, 1]);
        header.extend([0xff, 0x5c, 0, 4, 0x40, 0x60, 0xff, 0x90, 0, 10, 0, 0, 0, 0, 0, 0, 0, 1, 0xff, 0x93]);
        change(&mut header);
        header
    }

    #[test]
    fn code_streams_that_would_take_more_memory_than_their_values_are_refused() {
        let plain = memory_of(&header(|_| ()), 24).unwrap();
        assert!(plain < 1 << 20, "{plain}");
        // More layers of smaller blocks.
        let layers = memory_of(&header(|h| h[52] = 32), 24).unwrap();
        assert!(layers > plain && memory_of(&header(|h| (h[55], h[56]) = (0, 0)), 24).unwrap() > plain, "{layers}");
        for (what, change) in [
            ("another width", (11, 7)),
            ("an offset", (19, 1)),
            ("two tiles", (27, 3)),
            ("two components", (41, 2)),
            ("signs", (42, 0x80 | 11)),
            ("points left out", (43, 2)),
            ("precincts", (49, 1)),
            ("another marker", (60, 0x5f)),
            ("a length of nothing", (62, 1)),
            ("a header of its tile", (78, 0x52)),
        ] {
            assert!(memory_of(&header(|h| h[change.0] = change.1), 24).is_err(), "{what}");
        }
        for keep in 0..78 {
            assert!(memory_of(&header(|h| h.truncate(keep)), 24).is_err(), "{keep}");
        }
    }
}
