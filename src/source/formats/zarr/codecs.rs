//! Codecs of chunks, as they unpack. None takes more memory than the chunk's declared length, or unpacks to more.

use std::io::Read;

/// What was done to the bytes of a chunk, and is undone.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Step {
    Gzip,
    Zlib,
    Zstd,
    Blosc,
    /// With the length in four bytes before, as numcodecs writes it.
    Lz4,
    /// A checksum in four bytes behind.
    Crc32c,
    /// First bytes of all elements, then second bytes, and so on; the bytes of an element.
    Shuffle(usize),
}

/// The latest format of Blosc 1, in the first byte.
const BLOSC_1: u8 = 2;
/// Flags in the third byte of its header: bits were shuffled; the data are stored as they are.
const BLOSC_BITSHUFFLE: u8 = 4;
const BLOSC_STORED: u8 = 2;
/// Names of the codecs, for messages.
pub const ACCEPTED: &str = "gzip, zlib, zstd, blosc, lz4, crc32c, shuffle, bitround, bytes, transpose and sharding_indexed";

/// Bytes in which a chunk that unpacks to `bytes` may be stored, and what its codecs may make of it in between. Codecs make data that
/// they cannot compress a little longer.
pub fn most_stored(bytes: u64) -> u64 {
    bytes.saturating_add(bytes / 4).saturating_add(1 << 16)
}

/// Undoes the steps, in their order.
///
/// # Errors
/// Damaged data, or another length than `expected` at the end.
pub fn unpack(steps: &[Step], mut data: Vec<u8>, expected: u64) -> Result<Vec<u8>, String> {
    for step in steps {
        data = step.undo(data, expected)?;
    }
    if data.len() as u64 == expected {
        return Ok(data);
    }
    Err(format!("it unpacks to {} bytes; its metadata say {expected}", data.len()))
}

impl Step {
    fn undo(self, mut data: Vec<u8>, expected: u64) -> Result<Vec<u8>, String> {
        let most = most_stored(expected);
        match self {
            Self::Gzip => inflate(flate2::read::MultiGzDecoder::new(&data[..]), expected),
            Self::Zlib => inflate(flate2::read::ZlibDecoder::new(&data[..]), expected),
            Self::Zstd => {
                let mut out = Vec::new();
                let unpacked = zrip::DecompressContext::new().decompress_into_with_limit(&data, &mut out, most as usize);
                unpacked.map_err(|e| format!("zstd: {e}"))?;
                Ok(out)
            }
            // Filters of Blosc 2 that the crate does not know would give wrong values.
            Self::Blosc if data.first().is_some_and(|&version| version > BLOSC_1) => {
                Err(format!("blosc: its format has version {}; accepted are those of Blosc 1, up to {BLOSC_1}", data[0]))
            }
            Self::Blosc => {
                let bytes = blusc::blosc1_cbuffer_validate(&data, data.len()).map_err(|()| "blosc: its header is damaged")?;
                within(bytes as u64, most)?;
                let mut out = vec![0; bytes];
                let is_bitshuffled = data[2] & (BLOSC_BITSHUFFLE | BLOSC_STORED) == BLOSC_BITSHUFFLE;
                // The crate puts bits back wrongly where the elements of a block are no multiple of eight.
                data[2] &= !BLOSC_BITSHUFFLE;
                let unpacked = blusc::blosc1_decompress(&data, &mut out);
                if usize::try_from(unpacked) != Ok(bytes) {
                    return Err("blosc: it is damaged".into());
                }
                if is_bitshuffled && let Some((block, _)) = data[8..].split_first_chunk() {
                    let width = usize::from(data[3]).max(1);
                    out.chunks_mut((u32::from_le_bytes(*block) as usize).max(1)).for_each(|block| unshuffle_bits(block, width));
                }
                Ok(out)
            }
            Self::Lz4 => {
                let (length, packed) = data.split_first_chunk().ok_or("lz4: it is shorter than its header")?;
                let bytes = u32::from_le_bytes(*length);
                within(bytes.into(), most)?;
                lz4_flex::block::decompress(packed, bytes as usize).map_err(|e| format!("lz4: {e}"))
            }
            Self::Crc32c => {
                let (content, sum) = data.split_last_chunk().ok_or("crc32c: it is shorter than a checksum")?;
                let (stored, found) = (u32::from_le_bytes(*sum), crc32c::crc32c(content));
                if stored != found {
                    return Err(format!("crc32c: its checksum is {found:08x}, not {stored:08x}: it is damaged"));
                }
                data.truncate(data.len() - 4);
                Ok(data)
            }
            Self::Shuffle(width) => {
                // A rest that fills no element stays at the end.
                let count = data.len() / width;
                let mut out = data.clone();
                for (at, &byte) in data[..count * width].iter().enumerate() {
                    out[at % count * width + at / count] = byte;
                }
                Ok(out)
            }
        }
    }
}

/// Puts back the bits of a block of elements of `width` bytes, which Blosc 1 wrote bit by bit: the lowest bits of all first bytes, then their second bits,
/// and so on. A block whose elements are no multiple of eight is as it was.
fn unshuffle_bits(block: &mut [u8], width: usize) {
    let count = block.len() / width;
    if !count.is_multiple_of(8) {
        return;
    }
    let row = count / 8;
    let mut out = block.to_vec();
    out[..count * width].fill(0);
    for (at, &bits) in block[..count * width].iter().enumerate() {
        let (byte, bit, eighth) = (at / row / 8, at / row % 8, at % row);
        for element in 0..8 {
            out[(8 * eighth + element) * width + byte] |= (bits >> element & 1) << bit;
        }
    }
    block.copy_from_slice(&out);
}

fn within(bytes: u64, most: u64) -> Result<(), String> {
    if bytes <= most { Ok(()) } else { Err(format!("it unpacks to {bytes} bytes, more than its metadata say")) }
}

fn inflate(input: impl Read, expected: u64) -> Result<Vec<u8>, String> {
    let most = most_stored(expected);
    // Growing by doubling would take up to twice the memory. The length was checked against the limit.
    let mut out = Vec::new();
    out.try_reserve_exact(expected as usize).map_err(|_| format!("out of memory for {expected} bytes"))?;
    input.take(most + 1).read_to_end(&mut out).map_err(|e| e.to_string())?;
    within(out.len() as u64, most)?;
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    /// 0, 0, 0, 1, 1, 1 and so on, as 96 numbers of four bytes.
    fn what() -> Vec<u8> {
        (0..96u32).flat_map(|i| (i / 3).to_le_bytes()).collect()
    }

    fn gzip(data: &[u8]) -> Vec<u8> {
        let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::best());
        encoder.write_all(data).unwrap();
        encoder.finish().unwrap()
    }

    /// The same, packed: by numcodecs 0.16, and by ourselves.
    fn packed() -> Vec<(Vec<Step>, Vec<u8>)> {
        let hex = |text: &str| (0..text.len()).step_by(2).map(|i| u8::from_str_radix(&text[i..i + 2], 16).unwrap()).collect();
        let mut summed = gzip(&what());
        summed.extend(crc32c::crc32c(&summed).to_le_bytes());
        let mut all = vec![(vec![Step::Crc32c, Step::Gzip], summed)];
        all.extend(NUMCODECS.iter().map(|(step, text)| (vec![*step], hex(text))));
        all
    }

    #[test]
    fn what_numcodecs_packs_is_unpacked() {
        for (steps, data) in packed() {
            assert_eq!(unpack(&steps, data, what().len() as u64), Ok(what()), "{steps:?}");
        }
        let shuffled = (0..4).flat_map(|byte| what().into_iter().skip(byte).step_by(4)).collect();
        assert_eq!(unpack(&[Step::Shuffle(4)], shuffled, 384), Ok(what()));
    }

    /// By numcodecs 0.16, `Blosc(shuffle=BITSHUFFLE)` of 7 i % 100: 1001 numbers of one byte with lz4, 80 of two bytes with zstd, 243 of two bytes with lz4. A block
    /// of the first and the last is no multiple of eight.
    #[test]
    fn bits_that_numcodecs_shuffled_are_put_back() {
        let hex = |text: &str| (0..text.len()).step_by(2).map(|i| u8::from_str_radix(&text[i..i + 2], 16).unwrap()).collect::<Vec<u8>>();
        for (count, width, text) in BITSHUFFLED {
            let expected: Vec<u8> = (0..count).flat_map(|i| ((i * 7 % 100) as u16).to_le_bytes()[..width].to_vec()).collect();
            assert_eq!(unpack(&[Step::Blosc], hex(text), expected.len() as u64), Ok(expected), "{count} of {width}");
        }
    }

    const BITSHUFFLED: [(usize, usize, &str); 3] = [
        (
            1001,
            1,
            "02012401e9030000e90300008a0000001400000072000000ff5500070e151c232a31383f464d545b62050c131a21282f363d444b525960030a11181f262d343b424950575e01080f161d242b323940474e555c63060d141b222930373e454c535a61040b121920272e353c434a51585f020910171e252c333a41484f565d6400ffffff7050484f565d00",
        ),
        (
            80,
            2,
            "02019402a0000000a000000060000000140000004800000028b52ffd20a0fd01005403aaaa661e9ee1011ee6e11d1ee1542bb54aabb44aa9544a9833c68c33c78c31678ce043f8103c000fc287f0007c001fc007f003f80003100072130a23da",
        ),
        (
            243,
            2,
            "02012402e6010000e6010000c201000014000000d3000000ffb9000007000e0015001c0023002a00310038003f0046004d0054005b00620005000c0013001a00210028002f0036003d0044004b0052005900600003000a00110018001f0026002d0034003b0042004900500057005e00010008000f0016001d0024002b0032003900400047004e0055005c00630006000d0014001b0022002900300037003e0045004c0053005a00610004000b0012001900200027002e0035003c0043004a00510058005f0002000900100017001e0025002c0033003a00410048004f0056005d00c8001350210028002fd3000000ffb90036003d0044004b0052005900600003000a00110018001f0026002d0034003b0042004900500057005e00010008000f0016001d0024002b0032003900400047004e0055005c00630006000d0014001b0022002900300037003e0045004c0053005a00610004000b0012001900200027002e0035003c0043004a00510058005f0002000900100017001e0025002c0033003a00410048004f0056005d00000007000e0015001c0023002a00310038003f0046004d0054005b00620005000c0013001a00210028002fc80013500057005e00",
        ),
    ];

    #[test]
    fn other_lengths_and_damage_are_refused() {
        for (steps, data) in packed() {
            assert!(unpack(&steps, data.clone(), 383).unwrap_err().contains("metadata say"), "{steps:?}");
            for keep in 0..data.len() {
                assert!(unpack(&steps, data[..keep].to_vec(), 384).is_err(), "{steps:?} cut to {keep}");
            }
        }
    }

    #[test]
    fn bombs_are_refused_at_the_limit() {
        let zeros = vec![0u8; 1 << 24];
        let mut lz4 = (zeros.len() as u32).to_le_bytes().to_vec();
        lz4.extend(lz4_flex::block::compress(&zeros));
        let twice = gzip(&gzip(&zeros));
        let mut blosc = vec![0; zeros.len() + 64];
        let length = blusc::blosc1_compress(5, 1, 4, &zeros, &mut blosc);
        blosc.truncate(length as usize);
        let bombs = [
            (&[Step::Gzip][..], gzip(&zeros)),
            (&[Step::Gzip, Step::Gzip], twice),
            (&[Step::Zstd], zrip::compress(&zeros, 1).unwrap()),
            (&[Step::Blosc], blosc),
            (&[Step::Lz4], lz4),
        ];
        for (steps, data) in bombs {
            assert!(data.len() < 1 << 18, "{steps:?}: {} bytes", data.len());
            assert!(unpack(steps, data.clone(), 1 << 10).is_err(), "{steps:?}");
            assert!(unpack(steps, data, 1 << 24).is_ok_and(|out| out == zeros), "{steps:?}");
        }
    }

    #[test]
    fn blosc_2_is_refused() {
        let mut packed = vec![0; 1024];
        let length = blusc::blosc2_compress(5, 1, 4, &what(), &mut packed);
        packed.truncate(length as usize);
        let said = unpack(&[Step::Blosc], packed, 384).unwrap_err();
        assert!(said.contains("accepted are those of Blosc 1"), "{said}");
    }

    #[rustfmt::skip]
    const NUMCODECS: &[(Step, &str)] = &[
        (Step::Gzip, "1f8b08002e32046b00ff4dc3450e8300000030dc6d4336fcffbfe4489b34085e2123c64c983263ce82252bd66cd8b263cf811f7e3972e2cc853ffeb972e3ce83272fde7c00c6b1fc5a80010000"),
        (Step::Zlib, "789c4dc3450e8300000030dc6d4336fcffbfe4489b34085e2123c64c983263ce82252bd66cd8b263cf811f7e3972e2cc853ffeb972e3ce83272fde7c00e99e05d1"),
        (Step::Zstd, "28b52ffd6080007d0200140200000102030405060708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f2020e0c746cc1966c49c6146cc1966c49c6146cc1966c49c61469833cc8839c38c9833cc883965d8466c0b0b"),
        (Step::Lz4, "8001000017000100170104001702040017030400170404001705040017060400170704001708040017090400170a0400170b0400170c0400170d0400170e0400170f040017100400171104001712040017130400171404001715040017160400171704001718040017190400171a0400171b0400171c0400171d0400171e0400c01f0000001f0000001f000000"),
        (Step::Blosc, "02011104800100008001000084000000140000006c0000003f0000000101010202020303030404040505050606060707070808080909090a0a1f0a0b0b0b0c0c0c0d0d0d0e0e0e0f0f0f101010111111121212131313141414151f15151616161717171818181919191a1a1a1b1b1b1c1c1c1d1d1d1e1e1e1f1f1f0000e0ff1500010000"),
        (Step::Blosc, "02013104800100008001000086000000140000006e000000ff530000000101010202020303030404040505050606060707070808080909090a0a0a0b0b0b0c0c0c0d0d0d0e0e0e0f0f0f1010101111111212121313131414141515151616161717171818181919191a1a1a1b1b1b1c1c1c1d1d1d1e1e1e1f1f1f00000200ff07500000000000"),
        (Step::Blosc, "02013104800100008001000085000000140000006d000000ff520000000101010202020303030404040505050606060707070808080909090a0a0a0b0b0b0c0c0c0d0d0d0e0e0e0f0f0f1010101111111212121313131414141515151616161717171818181919191a1a1a1b1b1b1c1c1c1d1d1d1e1e1e1f1f1f000100ff08500000000000"),
        (Step::Blosc, "02017104800100008001000073000000140000005b00000078daedc18501c3200000309ce2525cffffb21fec8225000008214208634c08a19432c638e7cff30821a4944a29adb531c65aeb9cf3de8710628ceffba69472cea5945a6b6badf73ec69873aeb5f6dee79c7b2ff8fbe90345e905d1"),
        (Step::Blosc, "0201910480010000800100008b000000140000007300000028b52ffd6080004d030014060000000101010202020303030404040505050606060707070808080909090a0a0a0b0b0b0c0c0c0d0d0d0e0e0e0f0f0f1010101111111212121313131414141515151616161717171818181919191a1a1a1b1b1b1c1c1c1d1d1d1e1e1e1f1f1f00010021870aa2"),
        (Step::Blosc, "02013404800100008001000042000000140000002a00000035388ee3030035c00ffc03003600f0ff0300460000ffff0600020f000212000f0200ff2a500000000000"),
        (Step::Blosc, "02019004800100008001000054000000140000003c00000028b52ffd6080009501001402000102030405060708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f0020a810f007e00f101ef10351fef201"),
    ];
}
