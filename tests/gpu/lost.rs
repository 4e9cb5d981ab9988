//! A device that is lost in the middle of a frame, for real: a kernel that traps takes the whole context with it, so that this happens in
//! a process of its own. (`tests/lost_device/` breaks a device at random points, without a GPU.)

use crate::scenes::device_when_lost;
use ridgewatch::backend::Device;
use ridgewatch::backend::cuda::GpuSettings;
use ridgewatch::config::SceneFile;
use ridgewatch::publish::compare_films;
use ridgewatch::run::{Event, Frame, RunError, RunOptions, Setup, run};
use std::path::Path;
use std::process::Command;
use std::sync::atomic::AtomicBool;

/// What the process of its own is told by: `cpu` or `stop`, or `network` for a gated run that learns.
const WHEN_LOST: &str = "RIDGEWATCH_TEST_WHEN_LOST";

#[test]
#[ignore = "needs a GPU"]
fn the_run_goes_on_on_the_cpu_or_ends_as_configured() {
    for when_lost in ["cpu", "stop", "network"] {
        let output = Command::new(std::env::current_exe().unwrap())
            .args(["--ignored", "--exact", "lost::in_a_process_of_its_own", "--nocapture"])
            .env(WHEN_LOST, when_lost)
            .output()
            .unwrap();
        let said = format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
        println!("{said}");
        assert!(output.status.success(), "{when_lost}: {} {said}", output.status);
        assert!(said.contains("the context is gone"), "{when_lost}: nothing was broken: {said}");
    }
}

fn scene(when_lost: &str) -> SceneFile {
    let text = format!(
        "[source]\nkind = \"turbulence\"\nnodes = [48, 32, 32]\nsnapshots = 8\n[time]\ntau = 4\n[flow]\nsteps = 8\n[device]\nwhen_lost = \"{when_lost}\"\n\
         [render]\nmethod = \"reference\"\nwidth = 96\nheight = 64\nsamples = 16\n"
    );
    SceneFile::parse(Path::new("scene.toml"), &text, &[]).unwrap()
}

fn frames(scene: &SceneFile, device: Device, breaks: bool) -> (Vec<Frame>, Option<RunError>) {
    let options = RunOptions { device, ..RunOptions::default() };
    let (mut frames, mut broken) = (Vec::new(), !breaks);
    let mut sink = |event: Event| match event {
        Event::Frame(frame) => frames.push(frame),
        // In the third frame, with some paths done.
        Event::Progress(share) if frames.len() == 2 && share > 0.0 && !std::mem::replace(&mut broken, true) => trap(),
        _ => {}
    };
    let error = run(Setup::new(scene.settings()).unwrap(), &options, &mut sink, &AtomicBool::new(false)).err();
    assert!(broken, "the third frame told of its progress");
    (frames, error)
}

/// Ends the context that the whole process shares.
fn trap() {
    use cudarc::driver::{CudaContext, LaunchConfig, PushKernelArg};
    const PTX: &str = ".version 7.0\n.target sm_70\n.address_size 64\n.visible .entry fault(.param .u32 unused)\n{\n trap;\n}\n";
    let context = CudaContext::new(0).unwrap();
    let fault = context.load_module(cudarc::nvrtc::Ptx::from_src(PTX)).unwrap().load_function("fault").unwrap();
    let stream = context.new_stream().unwrap();
    let one = LaunchConfig { grid_dim: (1, 1, 1), block_dim: (1, 1, 1), shared_mem_bytes: 0 };
    // SAFETY: the kernel reads no argument; that it faults is what is wanted.
    unsafe { stream.launch_builder(&fault).arg(&0_u32).launch(one) }.unwrap();
    let error = stream.synchronize().unwrap_err();
    println!("the context is gone: {error:?}");
}

#[test]
#[ignore = "needs a GPU; started by the test above"]
fn in_a_process_of_its_own() {
    let Ok(when_lost) = std::env::var(WHEN_LOST) else { return };
    if when_lost == "network" {
        return a_gated_run_learns_on();
    }
    let scene = scene(&when_lost);
    let (expected, error) = frames(&scene, Device::CPU, false);
    assert!(error.is_none() && expected.len() == 4);
    let (found, error) = frames(&scene, device_when_lost(GpuSettings::default(), scene.device.when_lost), true);
    for (i, (found, expected)) in found.iter().zip(&expected).enumerate() {
        let (record, lost) = (&found.record, i >= 2);
        assert_eq!(record.device.starts_with("cuda:0"), !lost, "frame {i}: {}", record.device);
        assert_eq!(record.warnings.iter().any(|w| w.contains("work on the GPU has ended")), i == 2, "frame {i}: {:?}", record.warnings);
        let psnr = compare_films(&found.film, &expected.film, [1.0, 0.0, 1.0]).unwrap().psnr.unwrap_or(f64::INFINITY);
        println!("{when_lost}, frame {i}: {}, {psnr:.1} dB, {} queries, CPU {}", record.device, record.queries, expected.record.queries);
        println!("  {:?}", record.warnings);
        // As in render.rs: answers that differ in their last places.
        assert!(psnr > 50.0, "frame {i}: {psnr} dB");
        assert!((record.queries as f64 / expected.record.queries as f64 - 1.0).abs() < 5e-3, "frame {i}: counted once");
    }
    match when_lost.as_str() {
        "cpu" => assert!(error.is_none() && found.len() == 4, "{error:?} after {} frames", found.len()),
        _ => {
            assert!(matches!(&error, Some(RunError::Device(_))), "{error:?}");
            assert_eq!(found.len(), 2);
            println!("ended with: {}", error.unwrap());
        }
    }
}

/// A table of 8 MiB under a cap of 10 MiB, part of which the window takes: the device traces the table, the CPU keeps it and renders, and one warning says so.
/// The run goes on although it is to end with the device.
#[test]
#[ignore = "needs a GPU"]
fn memory_that_lacks_is_no_loss() {
    let text = "[source]\nkind = \"turbulence\"\nnodes = [48, 32, 32]\nsnapshots = 8\n[time]\ntau = 4\n[flow]\nsteps = 8\n[surrogate]\nkind = \"table\"\n\
         table_nodes = [128, 128, 128]\n[device]\nwhen_lost = \"stop\"\n[render]\nmethod = \"surrogate\"\nwidth = 96\nheight = 64\nsamples = 16\n";
    let scene = SceneFile::parse(Path::new("scene.toml"), text, &[]).unwrap();
    let (expected, error) = frames(&scene, Device::CPU, false);
    assert!(error.is_none() && expected.len() == 4);
    let settings = GpuSettings { memory_cap: Some(10 << 20), ..GpuSettings::default() };
    let (found, error) = frames(&scene, device_when_lost(settings, scene.device.when_lost), false);
    assert!(error.is_none() && found.len() == 4, "{error:?} after {} frames", found.len());
    for (i, (found, expected)) in found.iter().zip(&expected).enumerate() {
        let record = &found.record;
        let psnr = compare_films(&found.film, &expected.film, [1.0, 0.0, 1.0]).unwrap().psnr.unwrap_or(f64::INFINITY);
        println!("frame {i}: {}, {psnr:.1} dB, {:?}", record.device, record.warnings);
        let told = record.warnings.iter().filter(|told| told.contains("the CPU renders the frames and the GPU traces for them"));
        assert_eq!((record.device.starts_with("cuda:0"), told.count()), (true, usize::from(i == 0)), "frame {i}: {:?}", record.warnings);
        // As in render.rs: answers that differ in their last places.
        assert!(psnr > 50.0, "frame {i}: {psnr} dB");
    }
}

/// Traced, answered and trained on the device until it is lost in frame 2. That frame is thrown away and made again by the CPU, which goes on from the last
/// host copy of the weights: those that the network had before it went to the device.
fn a_gated_run_learns_on() {
    const STEPS: u64 = 60;
    let text = format!(
        "[source]\nkind = \"turbulence\"\nnodes = [48, 24, 24]\n[time]\ntau = 8\nslides = 1\nframes_per_slide = 6\n[flow]\nsteps = 16\n\
         [surrogate]\nkind = \"network\"\n[network]\nlevels = 4\nlog2_table = 14\nbase_resolution = 8\nwidth = 16\nbatch = 4096\n\
         [training]\nsteps_per_frame = {STEPS}\n[device]\nwhen_lost = \"cpu\"\n[render]\nmethod = \"gated\"\nwidth = 96\nheight = 64\nsamples = 16\n"
    );
    let scene = SceneFile::parse(Path::new("scene.toml"), &text, &[]).unwrap();
    let (found, error) = frames(&scene, device_when_lost(GpuSettings::default(), scene.device.when_lost), true);
    assert!(error.is_none() && found.len() == 6, "{error:?} after {} frames", found.len());
    let mut lost_steps = 0;
    for (i, Frame { record, film, .. }) in found.iter().enumerate() {
        let (learned, ended) =
            (record.training.as_ref().unwrap(), record.warnings.iter().filter(|w| w.contains("work on the GPU has ended")));
        println!("network, frame {i}: {}, {learned:?}, {:?} dB, {:?}", record.device, record.surrogate_psnr, record.warnings);
        assert_eq!(ended.count(), usize::from(i == 2), "frame {i}: {:?}", record.warnings);
        assert_eq!(record.device.starts_with("cuda:0"), i < 2, "frame {i}: {}", record.device);
        assert!(film.rgba.iter().flatten().all(|value| value.is_finite()), "frame {i}");
        assert_eq!((learned.steps, learned.device_seconds.is_some()), (STEPS, i < 2), "frame {i}");
        lost_steps += learned.lost_steps;
    }
    // Nothing had come back within so short a time: what the two frames before had taken is told as lost.
    assert_eq!(lost_steps, 2 * STEPS);
    let [lost, last] = [3, 5].map(|i| found[i].record.surrogate_psnr.unwrap());
    assert!(last > lost, "it learns on: {lost} dB, then {last}");
}
