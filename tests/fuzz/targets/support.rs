//! Inputs of the fuzz targets.

/// Most bytes that an input changes in a good file.
const MOST_CHANGES: usize = 64;

/// An input as a file: odd first byte, the good file with changes of one byte each (place u32, value u8); even, the input itself.
pub fn file(good: &[u8], input: &[u8]) -> Vec<u8> {
    match input.split_first() {
        Some((kind, changes)) if kind % 2 == 1 => {
            let mut bytes = good.to_vec();
            for change in changes.chunks_exact(5).take(MOST_CHANGES) {
                let place = u32::from_le_bytes([change[0], change[1], change[2], change[3]]) as usize % bytes.len();
                bytes[place] = change[4];
            }
            bytes
        }
        Some((_, bytes)) => bytes.to_vec(),
        None => Vec::new(),
    }
}
