//! What is told of work that takes long.

use crate::numerics::double_gyre;
use ridgewatch::flow::{FlowError, FlowMap, Steps, cpu_tracer};
use ridgewatch::progress::work;
use std::time::Duration;

/// On one thread, so that it takes long on any machine.
#[test]
fn a_choice_of_steps_tells_how_far_the_log_stretch_is_from_what_is_allowed() {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let hopeless = FlowMap { steps: Steps::Auto { tolerance: 1e-300 }, ..FlowMap::tangent(10.0, 1) };
    let choose = || pool.install(|| cpu_tracer(double_gyre().0, &hopeless, 0.0).map(drop));
    let told: Vec<String> = std::thread::scope(|scope| {
        let choosing = scope.spawn(choose);
        let mut told = Vec::new();
        while !choosing.is_finished() {
            told.extend(work());
            std::thread::sleep(Duration::from_millis(20));
        }
        assert!(matches!(choosing.join().unwrap(), Err(FlowError::StepsNotFound { .. })));
        told
    });
    // Other tests of this process may choose steps meanwhile.
    let said = told.iter().find(|text| text.ends_with(", allowed are 1.0e-300")).unwrap_or_else(|| panic!("{told:?}"));
    assert!(said.starts_with("choosing the steps of a path: with ") && said.contains("the log-stretch differs by "), "{said}");
    let mut of_steps = told.iter().filter(|text| text.starts_with("choosing"));
    assert!(of_steps.all(|text| !text.contains(" left")), "when it ends is not known: {told:?}");
}
