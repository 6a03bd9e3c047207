//! Runs a stage on its own thread, while Python's main thread receives progress and Ctrl-C.

use crate::{fork, options, to_py_error};
use fastlgs::Run;
use fastlgs::progress::{Message, Sink};
use pyo3::prelude::*;
use pyo3::types::{PyBool, PyDict};
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::Duration;

/// Longest time until Ctrl-C is noticed.
const SIGNAL_INTERVAL: Duration = Duration::from_millis(50);

/// A progress message that is passed to Python.
enum Event {
    Stage {
        stage: &'static str,
        done: u64,
        total: u64,
        note: String,
    },
    Trained {
        step: fastlgs::progress::TrainStep,
        total: u32,
    },
    Warning(String),
}

impl Event {
    fn to_python<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let event = PyDict::new(py);
        match self {
            Self::Stage {
                stage,
                done,
                total,
                note,
            } => {
                event.set_item("stage", stage)?;
                event.set_item("done", done)?;
                event.set_item("total", total)?;
                event.set_item("note", note)?;
            }
            Self::Trained { step, total } => {
                event.set_item("stage", "train")?;
                event.set_item("done", step.iteration)?;
                event.set_item("total", total)?;
                event.set_item("loss", step.loss)?;
                event.set_item("psnr", step.psnr)?;
                event.set_item("gaussians", step.gaussians)?;
            }
            Self::Warning(text) => event.set_item("warning", text)?,
        }
        Ok(event)
    }
}

/// Progress sink that sends events to the main thread, and cancels the stage on request.
struct EventSink<'a> {
    events: std::sync::Mutex<Sender<Event>>,
    cancelled: &'a AtomicBool,
}

impl Sink for EventSink<'_> {
    fn on_message(&self, message: Message<'_>) {
        let event = match message {
            Message::Started { stage, total } => Event::Stage {
                stage,
                done: 0,
                total,
                note: String::new(),
            },
            Message::Advanced {
                stage,
                done,
                total,
                note,
            } => Event::Stage {
                stage,
                done,
                total,
                note: note.to_owned(),
            },
            Message::Trained { step, total, .. } => Event::Trained { step, total },
            Message::Warning(text) => Event::Warning(text.to_owned()),
            _ => return,
        };
        // The receiver may be closed.
        let _ = self
            .events
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner)
            .send(event);
    }

    fn cancelled(&self) -> bool {
        self.cancelled.load(Ordering::Relaxed)
    }
}

/// Waits for the next event. A receiver is not `Sync`; `&mut` makes the borrow `Send`.
fn wait(receiver: &mut Receiver<Event>) -> Result<Event, RecvTimeoutError> {
    receiver.recv_timeout(SIGNAL_INTERVAL)
}

/// Calls `progress` with an event. Returns false if it cancels the stage by returning `False`.
fn call_progress(py: Python<'_>, progress: Option<&Py<PyAny>>, event: &Event) -> PyResult<bool> {
    let Some(progress) = progress else {
        return Ok(true);
    };
    let returned = progress.call1(py, (event.to_python(py)?,))?;
    let is_false = returned
        .bind(py)
        .cast::<PyBool>()
        .is_ok_and(|value| !value.is_true());
    Ok(!is_false)
}

/// Runs `work` with the GIL released. `progress` is called with a dictionary for each event.
///
/// # Errors
/// Errors of the stage, exceptions of `progress`, and `KeyboardInterrupt`. The last two cancel the
/// stage first. `Cancelled` if `progress` returns `False`.
pub fn run<T: Send>(
    py: Python<'_>,
    progress: Option<Py<PyAny>>,
    device: &str,
    seed: u64,
    work: impl FnOnce(&Run) -> fastlgs::Result<T> + Send,
) -> PyResult<T> {
    fork::check()?;
    let cancelled = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let (events, mut receiver) = channel();
        let cancelled = &cancelled;
        let thread = scope.spawn(move || {
            let listener = EventSink {
                events: std::sync::Mutex::new(events),
                cancelled,
            };
            work(&Run {
                device,
                seed,
                progress: &listener,
            })
        });
        let mut interruption = None;
        loop {
            let event = py.detach(|| wait(&mut receiver));
            let called = match &event {
                Ok(event) => call_progress(py, progress.as_ref(), event),
                Err(RecvTimeoutError::Timeout) => Ok(true),
                Err(RecvTimeoutError::Disconnected) => break,
            };
            // The first interruption cancels the stage. Later ones are ignored until it has ended.
            match called.and_then(|continues| py.check_signals().map(|()| continues)) {
                Ok(true) => {}
                Ok(false) => cancelled.store(true, Ordering::Relaxed),
                Err(error) => {
                    interruption.get_or_insert(error);
                    cancelled.store(true, Ordering::Relaxed);
                }
            }
        }
        let result = py.detach(|| thread.join());
        match (interruption, result) {
            (Some(error), _) => Err(error),
            (None, Ok(result)) => result.map_err(to_py_error),
            (None, Err(panic)) => std::panic::resume_unwind(panic),
        }
    })
}

/// Runs a stage with some options replaced. Returns its report as Python objects.
///
/// # Errors
/// Invalid options, and errors of [`run`].
pub fn with_options<'py, C: Serialize + DeserializeOwned + Send, R: Serialize + Send>(
    py: Python<'py>,
    known: &C,
    options: Option<&Bound<'py, PyDict>>,
    progress: Option<Py<PyAny>>,
    device: &str,
    seed: u64,
    stage: fn(&C, &Run) -> fastlgs::Result<R>,
) -> PyResult<Bound<'py, PyAny>> {
    let config = options::with_options(known, options)?;
    options::to_python(
        py,
        &run(py, progress, device, seed, move |run| stage(&config, run))?,
    )
}
