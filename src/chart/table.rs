//! The figures of a chart as CSV: one line per measurement.

use super::Chart;
use std::fmt::Write;

/// All measurements of a chart. Columns that a panel does not have are empty.
pub fn csv(chart: &Chart) -> String {
    let mut out = String::from(
        "panel,method,setting,seconds,build_seconds,samples_per_second,bytes,rms,p99,psnr,psnr_all,relmse,ssim,stated_psnr,samples,steps\n",
    );
    let number = |value: Option<f64>| value.map_or(String::new(), |value| format!("{value:.6e}"));
    let text = |text: &str| format!("\"{}\"", text.replace('"', "\"\""));
    // Writing into a string does not fail.
    for point in chart.ftle.iter().flat_map(|panel| &panel.methods) {
        let _ = writeln!(
            out,
            "ftle,{},{},,{:.6e},{:.6e},{},{:.6e},{:.6e},{},,,,,,",
            text(&point.method),
            text(&point.setting),
            point.build_seconds,
            point.samples_per_second,
            point.bytes,
            point.rms,
            point.p99,
            number(point.psnr)
        );
    }
    for curve in chart.pictures.iter().flat_map(|panel| panel.curves.iter().chain(&panel.map)) {
        for frame in &curve.frames {
            let _ = writeln!(
                out,
                "picture,{},still,{:.6e},,,{},,,{:.4},{:.4},{:.6e},{},{},{:.4},",
                text(&curve.name()),
                frame.seconds,
                curve.bytes,
                frame.psnr,
                frame.psnr_all,
                frame.relmse,
                number(frame.ssim),
                number(frame.stated_psnr),
                frame.samples
            );
        }
        if let Some(sliding) = curve.sliding {
            let (seconds, psnr) = (1.0 / sliding.frames_per_second, number(sliding.psnr));
            let _ = writeln!(out, "picture,{},sliding,{seconds:.6e},,,{},,,{psnr},,,,,,", text(&curve.name()), curve.bytes);
        }
    }
    for point in chart.scaling.iter().flat_map(|panel| &panel.points) {
        for (method, nanoseconds, build, rms) in
            [("tracing", point.trace_ns, 0.0, point.rms), ("table", point.table_ns, point.table_seconds, point.table_rms)]
        {
            let setting = format!("{} {}", point.axis.name(), point.value);
            let (speed, rms) = (1e9 / nanoseconds, number(rms));
            let _ = writeln!(out, "scaling,{method},{},,{build:.6e},{speed:.6e},,{rms},,,,,,,,{}", text(&setting), point.steps);
        }
    }
    out
}
