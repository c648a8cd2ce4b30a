// Pulse generator for cameras: a pulse on PULSE_PIN at a set rate, numbered from 0, over a serial line.
// For boards with the Arduino core (RP2040: Raspberry Pi Pico; AVR: Uno, Nano). The protocol stands in
// hardware/triggers/serial_box.py. The pin gives 3.3 V (RP2040) or 5 V (AVR): look up what your cameras' opto-coupled
// inputs take (often 3.3 to 24 V at some mA) and put a driver between where they take more.
//
// The loop waits for each pulse with the clock in its hand and computes its time afresh, so that nothing adds up. Other
// interrupts (USB, serial) delay a pulse by some microseconds; for less use a timer's output pin, or an RP2040's PIO.
// A sketch to start from: it was not run on a board.

const int PULSE_PIN = 3;
const uint32_t SLOWEST_MILLIHERTZ = 100;
const uint32_t FASTEST_MILLIHERTZ = 2000000;

volatile bool running = false;
volatile uint32_t made = 0;      // pulses since the start
volatile uint64_t last_us = 0;   // when the last one began
uint32_t rate_millihertz = 100000;
uint32_t width_us = 100;
uint64_t begin_us = 0;

uint64_t now_us() {
#if defined(ARDUINO_ARCH_RP2040)
  return time_us_64();
#else
  static uint32_t before = 0, wraps = 0;  // micros() wraps after 71 minutes; called far more often than that
  noInterrupts();
  uint32_t now = micros();
  if (now < before) wraps++;
  before = now;
  uint64_t whole = ((uint64_t)wraps << 32) | now;
  interrupts();
  return whole;
#endif
}

// Pulse k is due at begin + k * 1e9 / rate_millihertz microseconds: computed afresh, so that nothing adds up.
uint64_t due_us(uint32_t pulse) {
  return begin_us + (uint64_t)pulse * 1000000000ULL / rate_millihertz;
}

void make_pulse() {
  digitalWrite(PULSE_PIN, HIGH);
  last_us = now_us();
  made++;
  delayMicroseconds(width_us);
  digitalWrite(PULSE_PIN, LOW);
}

void answer(char *line) {
  if (strcmp(line, "V") == 0) {
    Serial.println("V mosca-pulse 1");
  } else if (line[0] == 'F' && line[1] == ' ' && !running) {
    uint32_t asked = strtoul(line + 2, NULL, 10);
    rate_millihertz = constrain(asked, SLOWEST_MILLIHERTZ, FASTEST_MILLIHERTZ);
    Serial.print("F ");
    Serial.println(rate_millihertz);
  } else if (line[0] == 'W' && line[1] == ' ') {
    // a pulse is at most half a period long
    width_us = min(strtoul(line + 2, NULL, 10), 500000000UL / rate_millihertz);
    Serial.print("W ");
    Serial.println(width_us);
  } else if (strcmp(line, "S 1") == 0) {
    made = 0;
    begin_us = now_us();
    running = true;
    make_pulse();
    Serial.println("S 1");
  } else if (strcmp(line, "S 0") == 0) {
    running = false;
    Serial.print("S 0 ");
    Serial.println(made);
  } else if (line[0] == 'P' && line[1] == ' ' && running) {
    noInterrupts();
    uint32_t pulse = made - 1;
    uint64_t since = now_us() - last_us;
    interrupts();
    Serial.print("P ");
    Serial.print(line + 2);
    Serial.print(" ");
    Serial.print(pulse);
    Serial.print(" ");
    Serial.println((uint32_t)since);
  } else {
    Serial.println("E not understood, or not now");
  }
}

void setup() {
  pinMode(PULSE_PIN, OUTPUT);
  digitalWrite(PULSE_PIN, LOW);
  Serial.begin(115200);
}

void loop() {
  static char line[32];
  static uint8_t length = 0;
  // the pulse comes first; a character is read only where there is time for it before the next one
  if (running) {
    uint64_t due = due_us(made);
    uint64_t now = now_us();
    if (now + 200 >= due) {
      while (now_us() < due) {
      }
      make_pulse();
      return;
    }
  }
  if (Serial.available()) {
    char c = Serial.read();
    if (c == '\n') {
      line[length] = 0;
      answer(line);
      length = 0;
    } else if (c != '\r' && length < sizeof(line) - 1) {
      line[length++] = c;
    }
  }
}
