//! The device itself: kernels kept on disk, memory under a cap.

use super::scenes::{gpu, opened};
use ridgewatch::backend::cuda::{DeviceError, Gpu, GpuSettings, probe};

#[test]
#[ignore = "needs a GPU"]
fn it_is_found_and_named() {
    assert_eq!(probe().unwrap()[0].name, gpu().name());
    assert!(matches!(Gpu::open(4096, &GpuSettings::default()), Err(DeviceError::NoSuchDevice { asked: 4096, .. })));
}

#[test]
#[ignore = "needs a GPU"]
fn kernels_are_kept_and_damaged_ones_compiled_again() {
    let folder = tempfile::tempdir().unwrap();
    let settings = GpuSettings { cache: Some(folder.path().to_owned()), ..GpuSettings::default() };
    let load = || Gpu::open(0, &settings).unwrap().kernel("sort.cu", &[], "sort_count").unwrap();
    load();
    let files: Vec<_> = std::fs::read_dir(folder.path()).unwrap().map(|f| f.unwrap().path()).collect();
    assert_eq!(files.len(), 1);
    let whole = std::fs::read(&files[0]).unwrap();
    let written = || std::fs::metadata(&files[0]).unwrap().modified().unwrap();
    let first = written();
    load();
    assert_eq!((std::fs::read(&files[0]).unwrap(), written()), (whole.clone(), first), "read, not compiled again");
    std::fs::write(&files[0], &whole[..whole.len() / 2]).unwrap();
    load();
    assert_eq!(std::fs::read(&files[0]).unwrap().len(), whole.len(), "compiled and kept again");
}

#[test]
#[ignore = "needs a GPU"]
fn memory_stays_under_the_cap() {
    let gpu = opened(GpuSettings { memory_cap: Some(1 << 20), ..GpuSettings::default() });
    let first = gpu.alloc::<u8>("a test", 1 << 19).unwrap();
    assert!(matches!(gpu.alloc::<u8>("a test", (1 << 19) + 1), Err(DeviceError::OutOfMemory { .. })));
    drop(first);
    let mut buffer = gpu.alloc::<u32>("a test", 1 << 18).unwrap();
    buffer.fill_bytes(0xab).unwrap();
    buffer.zero_front(3).unwrap();
    let mut back = vec![0; 1 << 18];
    buffer.read(&mut back).unwrap();
    assert_eq!(back[..4], [0, 0, 0, 0xabab_abab]);
    assert_eq!(back[(1 << 18) - 1], 0xabab_abab);
}

#[test]
#[ignore = "needs a GPU"]
fn fresh_memory_is_poisoned_in_tests() {
    let gpu = opened(GpuSettings::default());
    // What was there before is overwritten too: the second buffer gets the first one's memory.
    for _ in 0..2 {
        let mut buffer = gpu.alloc::<f32>("a test", 1000).unwrap();
        let mut back = vec![0.0; 1000];
        buffer.read(&mut back).unwrap();
        assert!(back.iter().all(|x| x.is_nan()));
        buffer.zero_front(1000).unwrap();
    }
}
