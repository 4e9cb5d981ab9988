//! Small GRIB files of both editions with simple packing, written here octet by octet (WMO Manual on Codes, FM 92).

use std::path::{Path, PathBuf};

/// Parameters by their codes: discipline, category and number of edition 2; table and number of edition 1 (ECMWF, whose table 2 is that of the WMO).
pub type Parameter = ([u8; 3], [u8; 2]);
pub const U: Parameter = ([0, 2, 2], [128, 131]);
pub const V: Parameter = ([0, 2, 3], [128, 132]);
pub const OMEGA: Parameter = ([0, 2, 8], [2, 39]);
pub const TEMPERATURE: Parameter = ([0, 0, 0], [2, 11]);

/// Types of level: code of edition 2, what a unit of edition 1 counts there, and its code in edition 1.
pub type LevelType = (u8, f64, u8);
pub const ISOBARIC: LevelType = (100, 100.0, 100);
pub const HEIGHT: LevelType = (103, 1.0, 105);

/// A message.
#[derive(Clone)]
pub struct Message {
    pub edition: u8,
    pub parameter: Parameter,
    /// In hPa or m.
    pub level: (LevelType, f64),
    /// Hours between 2000-01-01 and the start of the forecast, fewer than 24.
    pub hour: u8,
    /// Hours of the forecast.
    pub step: u8,
    pub member: Option<u8>,
    /// First and last longitude and latitude, in the order of the axes, and the nodes between, both included.
    pub longitudes: (f64, f64, usize),
    pub latitudes: (f64, f64, usize),
    /// The flags 0x20 (columns follow each other) and 0x10 (every other one runs backwards); those of the directions follow from the axes.
    pub order: u8,
    /// Rows (latitude, longitude) in the order of the axes: multiples of 1/4 within 16,000; NaN is missing.
    pub values: Vec<f64>,
    /// Bits of a packed number.
    pub bits: u8,
    /// Template of section 3 of edition 2, and its octets from 39 on: another grid of as many nodes.
    pub plane: Option<(u8, Vec<u8>)>,
}

/// Octets from 39 on of template 3.30 (Lambert's cone): the grid of the High-Resolution Rapid Refresh (NOAA), every 3 km northwards and eastwards.
pub fn cone(along_grid: bool) -> (u8, Vec<u8>) {
    let degrees = |value: f64| signed((value * 1e6).round() as i64, 4);
    let step = 3_000_000u32.to_be_bytes();
    let octets = [
        &degrees(21.138_123)[..],
        &degrees(237.280_472),
        &[if along_grid { 0x08 } else { 0 }],
        &degrees(38.5),
        &degrees(262.5),
        &step,
        &step,
        &[0, 0x40],
        &degrees(38.5),
        &degrees(38.5),
        &degrees(-90.0),
        &degrees(0.0),
    ];
    (30, octets.concat())
}

/// Numbers are packed in quarters.
const BINARY: i32 = -2;

impl Message {
    pub fn bytes(&self) -> Vec<u8> {
        let (nx, ny) = (self.longitudes.2, self.latitudes.2);
        let (columns, back) = (self.order & 0x20 != 0, self.order & 0x10 != 0);
        let stored: Vec<f64> = (0..nx * ny)
            .map(|k| {
                let length = if columns { ny } else { nx };
                let (inner, outer) = (k % length, k / length);
                let inner = if back && outer % 2 == 1 { length - 1 - inner } else { inner };
                self.values[if columns { inner * nx + outer } else { outer * nx + inner }]
            })
            .collect();
        let there: Vec<f64> = stored.iter().copied().filter(|v| !v.is_nan()).collect();
        let least = there.iter().copied().fold(f64::INFINITY, f64::min);
        let packed = bits(there.iter().map(|v| ((v - least) * 4.0) as u64), self.bits);
        let bitmap = (there.len() < stored.len()).then(|| bits(stored.iter().map(|v| u64::from(!v.is_nan())), 1));
        if self.edition == 1 { self.edition_1(least, &packed, bitmap) } else { self.edition_2(least, there.len(), &packed, bitmap) }
    }

    fn scanning(&self) -> u8 {
        let westward = self.longitudes.1 < self.longitudes.0;
        let northward = self.latitudes.1 > self.latitudes.0;
        self.order | if westward { 0x80 } else { 0 } | if northward { 0x40 } else { 0 }
    }

    fn edition_1(&self, least: f64, packed: &[u8], bitmap: Option<Vec<u8>>) -> Vec<u8> {
        let ([table, number], ((_, _, kind), level)) = (self.parameter.1, self.level);
        let flags = 0x80 | if bitmap.is_some() { 0x40 } else { 0 };
        let level = (level as u16).to_be_bytes();
        let mut product = vec![
            table, 98, 0, 255, flags, number, kind, level[0], level[1], 100, 1, 1, self.hour, 0, 1, self.step, 0, 0, 0, 0, 0, 20, 0, 0, 0,
        ];
        if let Some(member) = self.member {
            // The local description 1 of ECMWF; octet 50 is the member.
            product.resize(37, 0);
            product.extend([1, 0, 0, 0, 0, 0, 0, 0, 0, member, 10]);
        }
        let degrees = |value: f64| signed((value * 1000.0).round() as i64, 3);
        let (x, y) = (self.longitudes, self.latitudes);
        let count = |n: usize| (n as u16).to_be_bytes();
        let grid = [
            &[0, 255, 0][..],
            &count(x.2),
            &count(y.2),
            &degrees(y.0),
            &degrees(x.0),
            &[0],
            &degrees(y.1),
            &degrees(x.1),
            &[255; 4],
            &[self.scanning()],
            &[0; 4],
        ]
        .concat();
        let data = [&[0][..], &signed(BINARY.into(), 2), &ibm(least), &[self.bits], packed].concat();
        let mut body = [section_1(&product), section_1(&grid)].concat();
        if let Some(bitmap) = bitmap {
            body.extend(section_1(&[&[0, 0, 0][..], &bitmap].concat()));
        }
        body.extend(section_1(&data));
        let length = (body.len() + 12) as u32;
        [b"GRIB", &length.to_be_bytes()[1..], &[1], &body[..], b"7777"].concat()
    }

    fn edition_2(&self, least: f64, count: usize, packed: &[u8], bitmap: Option<Vec<u8>>) -> Vec<u8> {
        let ([discipline, category, number], ((kind, unit, _), level)) = (self.parameter.0, self.level);
        let degrees = |value: f64| signed((value * 1e6).round() as i64, 4);
        let word = |n: usize| (n as u32).to_be_bytes();
        let (x, y) = (self.longitudes, self.latitudes);
        let reference = [&[0, 98, 0, 0, 30, 0, 1][..], &2000u16.to_be_bytes(), &[1, 1, self.hour, 0, 0, 0, 1]].concat();
        let template = self.plane.as_ref().map_or(0, |plane| plane.0);
        let head = [&[0][..], &word(x.2 * y.2), &[0, 0, 0, template, 6], &[255; 15], &word(x.2), &word(y.2)].concat();
        let rows =
            [&[0; 4][..], &[255; 4], &degrees(y.0), &degrees(x.0), &[0], &degrees(y.1), &degrees(x.1), &[255; 8], &[self.scanning()]]
                .concat();
        let grid = [head, self.plane.as_ref().map_or(rows, |plane| plane.1.clone())].concat();
        let template = if self.member.is_some() { 1 } else { 0 };
        let surface = [&[kind, 0][..], &word((level * unit) as usize), &[255, 0, 0, 0, 0, 0]].concat();
        let mut product = [&[0, 0, 0, template, category, number, 2, 0, 0, 0, 0, 0, 1][..], &word(self.step.into()), &surface].concat();
        product.extend(self.member.into_iter().flat_map(|member| [3, member, 10]));
        let packing = [&word(count)[..], &[0, 0], &(least as f32).to_be_bytes(), &signed(BINARY.into(), 2), &[0, 0, self.bits, 0]].concat();
        let map = bitmap.map_or(vec![255], |bitmap| [&[0][..], &bitmap].concat());
        let sections = [(1, &reference[..]), (3, &grid), (4, &product), (5, &packing), (6, &map), (7, packed)];
        let body: Vec<u8> =
            sections.into_iter().flat_map(|(number, bytes)| [&word(bytes.len() + 5)[..], &[number], bytes].concat()).collect();
        let length = (body.len() + 20) as u64;
        [b"GRIB", &[0, 0, discipline, 2][..], &length.to_be_bytes(), &body, b"7777"].concat()
    }
}

/// Writes messages one after the other.
pub fn write(messages: &[Message], path: &Path) -> PathBuf {
    std::fs::write(path, messages.iter().flat_map(Message::bytes).collect::<Vec<u8>>()).unwrap();
    path.to_owned()
}

fn section_1(bytes: &[u8]) -> Vec<u8> {
    [&(bytes.len() as u32 + 3).to_be_bytes()[1..], bytes].concat()
}

/// Numbers of so many bits, padded to whole bytes.
fn bits(numbers: impl Iterator<Item = u64>, width: u8) -> Vec<u8> {
    let all: Vec<bool> = numbers.flat_map(|n| (0..width).rev().map(move |k| n >> k & 1 == 1)).collect();
    all.chunks(8).map(|byte| byte.iter().enumerate().fold(0, |byte, (k, &bit)| byte | u8::from(bit) << (7 - k))).collect()
}

/// A number whose first bit is its sign.
fn signed(value: i64, bytes: usize) -> Vec<u8> {
    let size = value.unsigned_abs() | if value < 0 { 1 << (8 * bytes - 1) } else { 0 };
    size.to_be_bytes()[8 - bytes..].to_vec()
}

/// A number below 2^24 quarters as IBM's System/360 has it.
fn ibm(value: f64) -> [u8; 4] {
    let mut fraction = value.abs();
    let mut exponent = 64;
    while fraction >= 1.0 {
        fraction /= 16.0;
        exponent += 1;
    }
    let bits = (fraction * f64::from(1 << 24)) as u32 | exponent << 24 | if value < 0.0 { 1 << 31 } else { 0 };
    bits.to_be_bytes()
}

/// Messages that another encoder wrote: the packing, and both components.
pub fn real() -> Vec<(&'static str, [Vec<u8>; 2])> {
    let unhex = |text: &str| (0..text.len()).step_by(2).map(|i| u8::from_str_radix(&text[i..i + 2], 16).unwrap()).collect();
    REAL.iter().map(|(packing, u, v)| (*packing, [unhex(u), unhex(v)])).collect()
}

/// Fields of 6 x 4 nodes that ecCodes 2.50 wrote, each with its own packing (`packingType`): its name, and the messages of both components.
#[rustfmt::skip]
const REAL: &[(&str, &str, &str)] = &[
    ("grid_simple of edition 1", "4752494200009001000034806280ff80836401f41701010c00010000000000001500000000000000000000000000000001010204013030303100000000002000ff000006000400afc800000080003a9800c350271027100000000000000030088008c14000000c0000c01802403003c00402404406408400001004407800803c07002406c0100580a004400037373737", "4752494200009001000034806280ff80846401f41701010c00010000000000001500000000000000000000000000000001010204013030303100000000002000ff000006000400afc800000080003a9800c350271027100000000000000030088008c14000000c0001803004806007800403005c08801003c01005009002c06c00802407802807c02c08000037373737"),
    ("grid_simple of edition 1, bitmap", "4752494200009801000034806280ffc0836401f41701010c00010000000000001500000000000000000000000000000001010204013030303100000000002000ff000006000400afc800000080003a9800c35027102710000000000000000a080000ff7fff0000002e048008c14000000c0000c01802403003c00402406408400001004407800803c07002406c0100580a00440037373737", "4752494200009801000034806280ffc0846401f41701010c00010000000000001500000000000000000000000000000001010204013030303100000000002000ff000006000400afc800000080003a9800c35027102710000000000000000a080000ff7fff0000002e048008c14000000c0001803004806007800403008801003c01005009002c06c00802407802807c02c0800037373737"),
    ("grid_simple", "47524942ffff000200000000000000d700000015010062000004000107e701010c00000002000000480300000000180000000006ffffffffffffffffffffffffffffff000000060000000400000000ffffffff02aea540000000003000e4e1c002faf080009896800098968000000000220400000000020200ff80000000010000000064000000c350ffffffffffff0000001505000000180000c0800000800800000c000000000606ff00000029070000c01802403003c00402404406408400001004407800803c07002406c0100580a0044037373737", "47524942ffff000200000000000000d700000015010062000004000107e701010c00000002000000480300000000180000000006ffffffffffffffffffffffffffffff000000060000000400000000ffffffff02aea540000000003000e4e1c002faf080009896800098968000000000220400000000020300ff80000000010000000064000000c350ffffffffffff0000001505000000180000c0800000800800000c000000000606ff00000029070001803004806007800403005c08801003c01005009002c06c00802407802807c02c080037373737"),
    ("grid_complex", "47524942ffff000200000000000000f100000015010062000004000107e701010c00000002000000480300000000180000000006ffffffffffffffffffffffffffffff000000060000000400000000ffffffff02aea540000000003000e4e1c002faf080009896800098968000000000220400000000020200ff80000000010000000064000000c350ffffffffffff0000002f05000000180002c080000080080000000001006258d19a00000000000000010c00000000180100000018000000000606ff00000029070000c01802403003c00402404406408400001004407800803c07002406c0100580a0044037373737", "47524942ffff000200000000000000f100000015010062000004000107e701010c00000002000000480300000000180000000006ffffffffffffffffffffffffffffff000000060000000400000000ffffffff02aea540000000003000e4e1c002faf080009896800098968000000000220400000000020300ff80000000010000000064000000c350ffffffffffff0000002f05000000180002c080000080080000000001006258d19a00000000000000010c00000000180100000018000000000606ff00000029070001803004806007800403005c08801003c01005009002c06c00802407802807c02c080037373737"),
    ("grid_complex, bitmap", "47524942ffff000200000000000000f300000015010062000004000107e701010c00000002000000480300000000180000000006ffffffffffffffffffffffffffffff000000060000000400000000ffffffff02aea540000000003000e4e1c002faf080009896800098968000000000220400000000020200ff80000000010000000064000000c350ffffffffffff0000002f05000000170002c080000080080000000001006258d19a00000000000000010c0000000017010000001700000000090600ff7fff00000028070000c01802403003c00402406408400001004407800803c07002406c0100580a00440037373737", "47524942ffff000200000000000000f300000015010062000004000107e701010c00000002000000480300000000180000000006ffffffffffffffffffffffffffffff000000060000000400000000ffffffff02aea540000000003000e4e1c002faf080009896800098968000000000220400000000020300ff80000000010000000064000000c350ffffffffffff0000002f05000000170002c080000080080000000001006258d19a00000000000000010c0000000017010000001700000000090600ff7fff00000028070001803004806007800403008801003c01005009002c06c00802407802807c02c0800037373737"),
    ("grid_complex_spatial_differencing", "47524942ffff000200000000000000f500000015010062000004000107e701010c00000002000000480300000000180000000006ffffffffffffffffffffffffffffff000000060000000400000000ffffffff02aea540000000003000e4e1c002faf080009896800098968000000000220400000000020200ff80000000010000000064000000c350ffffffffffff0000003105000000180003c0800000800800000c0001006258d19a0000000000000005000400000001010000000d0401020000000606ff0000002b07000088408409004c0a4000000000c00403c0000940b80b80140b80b80380cc0280cc0cc0280037373737", "47524942ffff000200000000000000f600000015010062000004000107e701010c00000002000000480300000000180000000006ffffffffffffffffffffffffffffff000000060000000400000000ffffffff02aea540000000003000e4e1c002faf080009896800098968000000000220400000000020300ff80000000010000000064000000c350ffffffffffff0000003105000000180003c0800000800800000c0001006258d19a0000000000000005000400000001010000000e0401020000000606ff0000002c0700008780780900040a4000000000c00402d0000a404c0b80b80140b80140940cc0280cc0280cc037373737"),
    ("grid_complex_spatial_differencing, bitmap", "47524942ffff000200000000000000f900000015010062000004000107e701010c00000002000000480300000000180000000006ffffffffffffffffffffffffffffff000000060000000400000000ffffffff02aea540000000003000e4e1c002faf080009896800098968000000000220400000000020200ff80000000010000000064000000c350ffffffffffff0000003105000000170003c0800000800800000c0001006258d19a00000000000000030004000000010100000011050102000000090600ff7fff0000002c0700008840840900000000c001204c0a40c40a40000940b80b80140b80b80380cc0280cc0cc0280037373737", "47524942ffff000200000000000000f900000015010062000004000107e701010c00000002000000480300000000180000000006ffffffffffffffffffffffffffffff000000060000000400000000ffffffff02aea540000000003000e4e1c002faf080009896800098968000000000220400000000020300ff80000000010000000064000000c350ffffffffffff0000003105000000170003c0800000800800000c0001006258d19a00000000000000030004000000010100000011050102000000090600ff7fff0000002c0700008780780900000000c00120040a40d00000a404c0b80b80140b80140940cc0280cc0280cc0037373737"),
    ("grid_ccsds", "47524942ffff000200000000000000e700000015010062000004000107e701010c00000002000000480300000000180000000006ffffffffffffffffffffffffffffff000000060000000400000000ffffffff02aea540000000003000e4e1c002faf080009896800098968000000000220400000000020200ff80000000010000000064000000c350ffffffffffff000000190500000018002ac0800000800800000c000e2000800000000606ff0000003507b000fb546a34a527fcc06018060180bfe4000000003ff40040a01fff02805fec0dfd804037f00000000000000000000037373737", "47524942ffff000200000000000000e700000015010062000004000107e701010c00000002000000480300000000180000000006ffffffffffffffffffffffffffffff000000060000000400000000ffffffff02aea540000000003000e4e1c002faf080009896800098968000000000220400000000020300ff80000000010000000064000000c350ffffffffffff000000190500000018002ac0800000800800000c000e2000800000000606ff0000003507b000f8d46a451a527fd80c0300c03009ff0060180bffc05fd000007fb007f903807ffc07fc000000000000000000000037373737"),
    ("grid_ccsds, bitmap", "47524942ffff000200000000000000ea00000015010062000004000107e701010c00000002000000480300000000180000000006ffffffffffffffffffffffffffffff000000060000000400000000ffffffff02aea540000000003000e4e1c002faf080009896800098968000000000220400000000020200ff80000000010000000064000000c350ffffffffffff000000190500000017002ac0800000800800000c000e200080000000090600ff7fff0000003507b000fb51a8d2949ff980c0300c03017fc8120001ffa0020500fff81402ff606fec0201bf80000000000000000000000037373737", "47524942ffff000200000000000000ea00000015010062000004000107e701010c00000002000000480300000000180000000006ffffffffffffffffffffffffffffff000000060000000400000000ffffffff02aea540000000003000e4e1c002faf080009896800098968000000000220400000000020300ff80000000010000000064000000c350ffffffffffff000000190500000017002ac0800000800800000c000e200080000000090600ff7fff0000003507b000f8c8d48a34a4ffd80c0300c03009ff00202fff017f400001fec01fe40e01fff01ff000000000000000000000000037373737"),
    ("grid_jpeg", "47524942ffff0002000000000000016e00000015010062000004000107e701010c00000002000000480300000000180000000006ffffffffffffffffffffffffffffff000000060000000400000000ffffffff02aea540000000003000e4e1c002faf080009896800098968000000000220400000000020200ff80000000010000000064000000c350ffffffffffff0000001705000000180028c0800000800800000c0000ff0000000606ff000000be07ff4fff5100290000000000060000000400000000000000000000000600000004000000000000000000010b0101ff52000c00000001000204040001ff5c000a4060686870686870ff640025000143726561746564206279204f70656e4a5045472076657273696f6e20322e352e32ff90000a0000000000490001ff93cfe41005cc0b05c0fc00a1fb01c1fb0100046f0325c2045fc7f2131fc84c7f808012c05259a0d6f8eca31385b94551829d20e7123fda6aab97eebfffd937373737", "47524942ffff0002000000000000017000000015010062000004000107e701010c00000002000000480300000000180000000006ffffffffffffffffffffffffffffff000000060000000400000000ffffffff02aea540000000003000e4e1c002faf080009896800098968000000000220400000000020300ff80000000010000000064000000c350ffffffffffff0000001705000000180028c0800000800800000c0000ff0000000606ff000000c007ff4fff5100290000000000060000000400000000000000000000000600000004000000000000000000010b0101ff52000c00000001000204040001ff5c000a4060686870686870ff640025000143726561746564206279204f70656e4a5045472076657273696f6e20322e352e32ff90000a00000000004b0001ff93cfe41006129c65c3f60287ec0b07ec04035703f554ff7f0158c7f2130fd8263fc04811930801d43b86003f0af00c8ccb758ff4820f83910f642394fa9fffd937373737"),
];
